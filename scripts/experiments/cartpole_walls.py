"""Cart-pole with soft walls: ACI-MPC VII-A, figures 3 and 4.

C3 (N = 10 knots of 10 ms, 10 rounds, rho 2, the convex projection) stabilises a pole
between two walls, which are 15 cm too far and 15 cm too near in its model. The learner
starts from zero and runs at 100 Hz. Every run is made with two plants: the LCS, so that
only the walls are wrong in the model, and a nonlinear MultibodyPlant whose walls are
compliant contacts. If it adapts, both are repeated without adaptation.

Criterion, set beforehand. A run has settled if the pole never lay flat (1.57 rad) and
max |x| over the last second, in m, rad, m/s and rad/s, is below 0.05. It is a success
if it has settled with both plants, and with the LCS every entry of r_comp is within
10 mm of the truth.

Of the paper's constants it gives the gap error, [-0.15, 0.15] m, and that r starts from
zero. Ours: eps 30, gamma 0.01 m/N (bound: 0.02), buffer of 10, five Adam steps of 3 mm
per update; initial state x_initial, drawn around by the seed. See
docs/residual_learning.md.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap, LogNorm

from makebreak.diagrams.cartpole_walls import (
    DT,
    CartpoleWallsConfig,
    initial_state,
    make_cartpole_walls,
    refuse_unused_settings,
    start,
    true_lcs,
)
from makebreak.diagrams.recorder import recorded, with_noise
from makebreak.models.scene import read_scene
from makebreak.scripts.runner.comparison import Comparison
from makebreak.scripts.runner.criteria import Criteria
from makebreak.scripts.runner.session import Log, Session
from makebreak.scripts.runner.table import Table
from makebreak.systems.contact_mpc.numerics.lcp import solve_lcp
from makebreak.systems.contact_mpc.numerics.lcs import simulate
from makebreak.systems.contact_mpc.numerics.residual_learner import (
    measured_step,
    violation_loss,
)

SUMMARY = "a cart-pole between soft walls that its model misplaces (ACI-MPC VII-A)"
Config = CartpoleWallsConfig

DURATION = 8.0  # [s]
SETTLED_BOUND, SETTLED_FOR = 0.05, 1.0  # [SI], [s]
FALLEN = np.pi / 2  # [rad]
RESIDUAL_BOUND = 0.01  # [m]
# (contact happened, contact predicted) -> name in result.json.
QUADRANTS = {
    (True, True): "agreed_contact",
    (True, False): "missed_contact",
    (False, True): "false_contact",
    (False, False): "agreed_free",
}


def run(config: CartpoleWallsConfig, session: Session) -> dict:
    """Runs both plants; see the module for the criterion."""
    refuse_unused_settings(config)
    x = initial_state(config)
    plain = replace(config, adapt=False)
    # All are built before any is run, so that bad settings raise at once. Meshcat's
    # recording shows the last one.
    diagrams = {}
    if config.adapt:
        diagrams["lcs_plain"] = make_cartpole_walls(plain)
        diagrams["multibody_plain"] = make_cartpole_walls(plain, multibody=True)
    diagrams["lcs"] = make_cartpole_walls(config)
    diagrams["multibody"] = make_cartpole_walls(config, True, session.meshcat)
    logs: dict[str, Log] = {}
    for name, diagram in diagrams.items():
        columns = {c: diagram.GetOutputPort(c) for c in ("x", "u", "r_comp")}
        logs[name] = session.simulate(
            diagram,
            DURATION,
            columns,
            period_sec=DT,
            until=lambda t, values: (
                "the pole has fallen" if abs(values["x"][1]) > FALLEN else ""
            ),
            label=name,
            context=start(diagram, x),
        )

    truth = np.array(config.gap_error)
    result: dict = {"success": False}
    for prefix, name in (("", "lcs"), ("multibody_", "multibody")):
        log = logs[name]
        r = log["r_comp"]
        result[f"{prefix}settled"] = has_settled(log)
        result[f"{prefix}residual_error_max"] = float(abs(r[-1] - truth).max())
        for i in range(2):
            result[f"{prefix}r_{i}_m"] = float(r[-1, i])
        result[f"{prefix}time_to_residual_s"] = time_to_stay(
            log.time, abs(r - truth).max(axis=1), RESIDUAL_BOUND
        )
        result[f"{prefix}state_max_last_second"] = float(abs(last(log)).max())
        if config.adapt:
            result[f"{prefix}settled_without_adaptation"] = has_settled(
                logs[f"{name}_plain"]
            )
    criteria = Criteria()
    still = f"all states below {SETTLED_BOUND} in the last {SETTLED_FOR} s"
    criteria.holds("settled", f"LCS as the plant: {still}", result["settled"])
    criteria.at_most(
        "residual", "LCS as the plant: error of the residual",
        result["residual_error_max"], RESIDUAL_BOUND, "m",
    )  # fmt: skip
    criteria.holds(
        "multibody_settled", f"MultibodyPlant: {still}", result["multibody_settled"]
    )
    result |= criteria.result()
    figure, shares = gradient_map(config)
    session.save_plot(figure, "gradient_map")
    session.save_plot(plot_runs(logs, truth), "stabilisation")
    result |= shares
    log = logs["multibody"]
    # The walls of the controller's model are in an LCS, not in a scene.
    columns = with_noise(recorded(log.diagram, log.context), config.seed)
    session.write_recording(columns, read_scene(config.world))
    return result


def last(log: Log) -> np.ndarray:
    """x over the last second, (n, 4)."""
    return log["x"][log.time >= log.time[-1] - SETTLED_FOR]


def has_settled(log: Log) -> bool:
    """Whether the pole is at rest at the end (a fall ends the log)."""
    return bool(abs(last(log)).max() < SETTLED_BOUND)


def time_to_stay(time, error, bound) -> float | None:
    """The time from which error (n,) stays below bound [s]; None if it ends above."""
    above = np.flatnonzero(error > bound)
    if above.size == 0:
        return float(time[0])
    return float(time[above[-1] + 1]) if above[-1] + 1 < len(time) else None


def contact_and_gradient(config: CartpoleWallsConfig, gap_error, x):
    """The learner's gradient at r = 0 for one step from each state x (n, 4) without
    input, with walls wrong by gap_error (2,) or (n, 2) [m]. Speed and input have no
    influence, as they do not enter the gaps and the other dynamics are known.

    Returns: happened, predicted (n, 2): whether a force acts in truth and in the model;
        force (n, 2): eps times the gradient [N].
    """
    truth, u = true_lcs(), np.zeros(1)
    error = np.broadcast_to(gap_error, (len(x), 2))
    c = config.learning
    Q_d = np.array(c.Q_d or np.ones(truth.n_x))
    happened, predicted, force = (np.zeros((len(x), 2)) for _ in range(3))
    for k, x_k in enumerate(x):
        x_next, happened[k] = simulate(truth, x_k, u)
        predicted[k] = solve_lcp(truth.F, truth.E @ x_k + truth.c - error[k])
        step = measured_step(truth, x_k, u, x_next, Q_d, c.eps)
        # The wrong model is the right one with the residual -error.
        force[k] = c.eps * violation_loss(step, -error[k], c.eps, c.gamma)[1][0]
    return happened > 0.0, predicted > 0.0, force


def gradient_map(config: CartpoleWallsConfig):
    """Figure 3: where the gradient is not zero, over states and over gaps.

    Returns: the figure; {key: fraction of pairs of state and wall without gradient}.
    """
    cart, angle = np.linspace(-0.6, 0.6, 62), np.linspace(-0.5, 0.5, 52)
    grid = np.stack(np.meshgrid(cart, angle, indexing="ij"), axis=-1).reshape(-1, 2)
    x = np.hstack([grid, np.zeros_like(grid)])
    happened, predicted, force = contact_and_gradient(config, config.gap_error, x)
    zero = abs(force) < 1e-9  # [N]; rounding is 1e-13 here.
    shares: dict = {}
    kind = np.zeros(happened.shape, int)  # Index in QUADRANTS, for each wall.
    for k, ((h, p), name) in enumerate(QUADRANTS.items()):
        there = (happened == h) & (predicted == p)
        kind[there] = k
        share = float(zero[there].mean()) if there.any() else None
        shares[f"gradient_zero_share_{name}"] = share

    figure, axes = plt.subplots(1, 3, figsize=(15, 4.8), layout="constrained")
    colors = ListedColormap(["#c44e52", "#dd8452", "#f2d35e", "#ffffff"])
    labels = ["contact, predicted", "contact, not predicted"]
    labels += ["no contact, predicted", "no contact, none predicted"]
    for wall, ax in enumerate(axes[:2]):
        image = kind[:, wall].reshape(62, 52).T
        ax.pcolormesh(cart, angle, image, cmap=colors, vmin=0, vmax=3)
        there = zero[:, wall]
        ax.plot(*grid[there].T, ".", ms=1.5, color="0.4")
        ax.set(title=f"wall {wall}", xlabel="cart [m]", ylabel="pole [rad]")
    handles: list = [
        plt.Rectangle((0, 0), 1, 1, fc=colors(i), ec="0.6") for i in range(4)
    ]
    handles.append(plt.Line2D([], [], marker=".", ls="", color="0.4"))
    axes[0].legend(handles, [*labels, "gradient is zero"], loc="lower left", fontsize=8)

    # For any error: true over modelled gap of wall 0, with the pole upright.
    gaps = np.linspace(-0.2, 0.2, 41)
    modelled, true = (g.ravel() for g in np.meshgrid(gaps, gaps, indexing="ij"))
    x, error = np.zeros((true.size, 4)), np.zeros((true.size, 2))
    x[:, 0], error[:, 0] = true_lcs().c[0] - true, true - modelled
    size = abs(contact_and_gradient(config, error, x)[2][:, 0]).reshape(41, 41)
    shown = np.ma.masked_less(size, 1e-9)
    image = axes[2].pcolormesh(gaps, gaps, shown, norm=LogNorm(1e-3, size.max()))
    figure.colorbar(image, ax=axes[2], label="eps |gradient| [N]; white: zero")
    axes[2].axhline(0, color="0.5", lw=0.8)
    axes[2].axvline(0, color="0.5", lw=0.8)
    axes[2].set(
        title="wall 0, any error",
        xlabel="true gap [m]",
        ylabel="modelled gap [m]",
        aspect=1,
    )
    return figure, shares


def plot_runs(logs: dict[str, Log], truth):
    """Figure 4: the state and r_comp over time, with and without adaptation."""
    figure, axes = plt.subplots(
        3, 2, figsize=(11, 8), sharex=True, sharey="row", layout="constrained"
    )
    for column, name in enumerate(("lcs", "multibody")):
        ax = axes[:, column]
        ax[0].set_title({"lcs": "LCS as plant", "multibody": "MultibodyPlant"}[name])
        for key, style, label in (
            (name, "-", "run"),
            (f"{name}_plain", "--", "without adaptation"),
        ):
            if key in logs:
                log = logs[key]
                ax[0].plot(log.time, log["x"][:, 1], style, color="C0", label=label)
                ax[1].plot(log.time, log["x"][:, 0], style, color="C0", label=label)
        log = logs[name]
        for i in range(2):
            ax[2].plot(log.time, log["r_comp"][:, i], color=f"C{i + 1}", label=f"r_{i}")
            ax[2].axhline(truth[i], color=f"C{i + 1}", ls=":")
        ax[0].legend()
        ax[2].legend()
        ax[2].set_xlabel("time [s]")
    axes[0, 0].set(ylabel="pole [rad]", ylim=(-1.6, 1.6))
    axes[1, 0].set(ylabel="cart [m]", ylim=(-1.5, 1.5))
    axes[2, 0].set(ylabel="r_comp [m]; dotted: truth")
    return figure


WIDE = {"x_initial": [0.0, 0.0, 0.0, 0.0], "x_spread": [0.2, 0.5, 0.5, 0.5]}
RIGHT = {"gap_error": [0.0, 0.0], "adapt": False}  # A baseline that must work.


def reproduce(session: Session, seeds: int, jobs: int) -> Table:
    """Figures 3 and 4 beside ours, over seeds, and from distant initial states."""

    comparison = Comparison("cartpole_walls", session, jobs)
    row = comparison.row

    def count(results, key):
        return f"{sum(bool(r.get(key)) for r in results)} of {len(results)}"

    variants: dict[str, dict] = {
        "near": {},
        "wide": WIDE,
        "right": {**WIDE, **RIGHT},
        "dynamics": {**WIDE, "learner": "r_dyn"},
    }
    near, wide, right, dynamics = comparison.runs_of(variants, seeds).values()

    def residual_errors(key):
        values = [r.get(key) for r in near]
        return [np.inf if value is None else value for value in values]

    def at_most(values):
        most = max(values)
        return f"at most {1e3 * most:.1f} mm" if most < np.inf else "not in all runs"

    errors = residual_errors("residual_error_max")
    body_errors = residual_errors("multibody_residual_error_max")
    commands = {name: comparison.with_settings(s) for name, s in variants.items()}
    all_settled = all(r.get("settled") for r in near)
    # A run that ended in an error lacks the key, and does not count.
    none_plain = all(r.get("settled_without_adaptation") is False for r in near)
    row("fig. 4: stabilised", "yes", count(near, "settled"), all_settled)
    worst = at_most(errors)
    good = max(errors) <= RESIDUAL_BOUND
    row("fig. 4: |r - truth| at the end", "converges", worst, good)
    ours = count(near, "settled_without_adaptation")
    row("without adaptation: stabilised", "-", ours, none_plain)
    ours = count(near, "multibody_settled")
    row("MultibodyPlant: stabilised", "-", ours)
    worst = at_most(body_errors)
    row("MultibodyPlant: |r - truth| at the end", "-", worst)
    ours = count(near, "multibody_settled_without_adaptation")
    row("MultibodyPlant, without adaptation", "-", ours)
    for name in QUADRANTS.values():
        share = near[0].get(f"gradient_zero_share_{name}")
        text = "-" if share is None else f"{100 * share:.0f} %"
        paper = "100 %" if name == "agreed_free" else "0 %"
        row(f"fig. 3: no gradient, {name.replace('_', ' ')}", paper, text)
    its = commands["wide"]
    row("start anywhere: stabilised", "-", count(wide, "settled"), command=its)
    ours = count(wide, "settled_without_adaptation")
    row("start anywhere, without adaptation", "-", ours, command=its)
    ours = count(dynamics, "settled")
    its = commands["dynamics"]
    row("start anywhere, residual on the dynamics", "-", ours, command=its)
    ours = count(right, "settled")
    row("start anywhere, walls known", "-", ours, command=commands["right"])
    return comparison.to_table(
        "Cart-pole with soft walls (ACI-MPC VII-A)",
        [
            "A wall that is neither met nor expected teaches nothing: from most states "
            "only one wall's r is learned.",
        ],
    )
