"""Plots of trials in which contacts are made and lost."""

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from makebreak.systems.changing_contact.numerics.contact_task import (
    PHASE_STAGE,
    REGION,
    ContactBelief,
)
from makebreak.systems.changing_contact.numerics.impact_score import low_pass


def plot_trials(trials: Mapping[str, Any]):
    """CC figure 16: speed, acceleration and force over time, a column for each trial.

    Args: trials: {name: trial with `log`, `touched` (n,) [s], `force` (n,) [N] and
        `completion` [s]}.
    """
    figure, axes = plt.subplots(
        3, len(trials), figsize=(5.0 * len(trials), 8), layout="constrained",
        sharey="row", squeeze=False,
    )  # fmt: skip
    for ax, (name, one) in zip(axes.T, trials.items(), strict=True):
        log, t = one.log, one.log["time"]
        v = log["ee_velocity"][:, :3]
        dt = t[1] - t[0]
        a = low_pass(np.gradient(v, dt, axis=0), 10.0, dt)
        force = low_pass(log["wrench"][:, :3], 100.0, dt)
        for i, axis in enumerate("xyz"):
            ax[0].plot(t, v[:, i], lw=1, label=axis)
            ax[1].plot(t, a[:, i], lw=1)
            ax[2].plot(t, force[:, i], lw=1)
        inside = log["phase"][:, PHASE_STAGE] == REGION
        for one_ax in ax:
            one_ax.fill_between(
                t, 0, 1, where=inside, transform=one_ax.get_xaxis_transform(),
                color="0.85", lw=0,
            )  # fmt: skip
            for when in one.touched[np.isfinite(one.touched)]:
                one_ax.axvline(when, color="0.3", lw=0.7, ls=":")
        ax[0].set_title(
            f"{name.replace('_', ' ')}: {one.completion:.1f} s, "
            f"peaks {', '.join(f'{f:.1f}' for f in one.force)} N"
        )
        ax[2].set_xlabel("time [s]; grey: in a region, dotted: contact")
    axes[0, 0].set_ylabel("tip velocity [m/s]")
    axes[1, 0].set_ylabel("acceleration, 10 Hz [m/s2]")
    axes[2, 0].set_ylabel("force on the tool, 100 Hz [N]")
    axes[0, 0].legend(loc="upper right", ncols=3)
    return figure


def plot_path(trials: Mapping[str, Any], prior: ContactBelief):
    """CC figure 15: the tip's path, from ahead and from above, and the estimates of the
    contacts with two standard deviations.

    Args: trials: {name: trial with `log`}.
    """
    figure, axes = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
    for ax, (i, j), title in zip(
        axes, ((1, 2), (0, 1)), ("from ahead", "from above"), strict=True
    ):
        for name, one in trials.items():
            p = one.log["ee_pose"]
            ax.plot(p[:, i], p[:, j], lw=1.2, label=name.replace("_", " "))
        for c in prior.contacts:
            sizes = 2.0 * np.sqrt(np.diag(c.covariance))
            ax.add_patch(plt.matplotlib.patches.Ellipse(  # type: ignore[attr-defined]
                (c.mean[i], c.mean[j]), 2 * sizes[i], 2 * sizes[j], color="C3",
                alpha=0.15, lw=0))  # fmt: skip
        ax.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]", title=title)
        ax.set_aspect("equal")
    axes[0].legend()
    return figure
