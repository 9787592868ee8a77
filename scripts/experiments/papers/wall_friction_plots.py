"""Plots of `wall_friction`: figures 11 to 14 of CC."""

import matplotlib.pyplot as plt
import numpy as np

from makebreak.scripts.experiments.papers.wall_friction_score import (
    SETS,
    Y,
    along_the_wall,
    contact_time,
)


def plot_joints(ahead: dict[str, tuple]):
    """Figures 11 and 12: joint 1, true and predicted from the start."""
    figure, axes = plt.subplots(
        1, 3, figsize=(15, 4.2), sharey=True, layout="constrained"
    )
    for ax, (name, values) in zip(axes, ahead.items(), strict=True):
        time, q, mean, std, contact = values
        frictions, is_stiff, number = SETS[name]
        ax.fill_between(
            time, mean - 2 * std, mean + 2 * std, alpha=0.3, label="2 std", color="C0"
        )
        ax.plot(time, mean, color="C0", label="predicted")
        ax.plot(time, q, "k--", label="true")
        ax.axvline(contact, color="0.4", ls=":")
        learned_from = f"{frictions[0]} to {frictions[-1]}" if frictions[1:] else "0.6"
        ax.set(
            title=f"fig. {number}: learned at {learned_from}"
            + (", stiff" if is_stiff else ""),
            xlabel="time [s]",
        )
    axes[0].set_ylabel("joint 1 [rad]")
    axes[0].legend(loc="upper left")
    return figure


def plot_forces(data, scratch, ahead):
    """Figures 13 and 14: the force along the wall, true and predicted."""
    figure, axes = plt.subplots(
        2, 3, figsize=(15, 7.5), sharex=True, height_ratios=(2, 1), layout="constrained"
    )
    time, force = data["time"], data["wrench"][:, Y]
    window, contact = along_the_wall(time), contact_time(data)
    mean, std = (np.interp(time, ahead[0], values) for values in ahead[1:])
    one = data["one_step.wrench_predicted"][:, Y], data["one_step.std"][:, Y]
    panels: tuple = (
        ("fig. 13: baseline, from the start", mean, std),
        ("fig. 14a: baseline, one step with feedback", *one),
        ("fig. 14b: our forward models", data["wrench_predicted"][:, Y], None),
    )
    for k, (title, mean, std) in enumerate(panels):
        ax, below = axes[:, k]
        for a, centre in ((ax, mean), (below, mean - force)):
            if std is not None:
                a.fill_between(
                    time, centre - 2 * std, centre + 2 * std, alpha=0.3, label="2 std"
                )
            a.axvline(contact, color="0.4", ls=":")
        ax.plot(time, force, "k", lw=0.6, label="measured")
        ax.plot(time, mean, color="C0", label="predicted")
        below.plot(time[window], (mean - force)[window], color="C0", lw=0.7)
        ax.set(title=title, ylim=(-14.0, 6.0))
        below.set(xlabel="time [s]", ylim=(-1.0, 1.0) if k else (-7.0, 7.0))
        below.axhline(0.0, color="0.4", lw=0.6)
    predicted = scratch["wrench_predicted"][:, Y]
    axes[1, 2].plot(
        time[window],
        (predicted - force)[window],
        color="C1",
        lw=0.7,
        zorder=1,
        label="nothing known before",
    )
    axes[1, 2].legend(loc="lower right")
    axes[0, 0].legend(loc="lower left")
    axes[0, 0].set_ylabel("force along the wall [N]")
    axes[1, 0].set_ylabel("error along the wall [N]")
    return figure
