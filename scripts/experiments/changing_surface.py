"""A block slides over three unknown surfaces: CC 4.3, figures 8, 9 and 10.

The path crosses each seam in several directions, ten times in all; each segment
presses with another force. The first time on a surface its mode is new, later it must
be recognised. Friction is 0.1 to 0.6 with gaps of 0.1 and more, forces are 6 to 12 N,
drawn by the seed. For comparison the same motion is done with constant K_max and with
constant K_free, both without feed-forward.

A seam begins where the first of the block's four feet leaves its surface, and ends
when the last one has; in between the block stands on both. Delays count from the end.
Counted from the moment when the tip itself is over the seam they are 0.12 s longer at
0.1 m/s; result.json has both.

Criterion, set beforehand. A run is a success if every change is recognised correctly,
a known mode within 0.15 s and a new one within 0.25 s; there is no surplus mode; the
tracking error (rms, across the force direction) is at most that of constant K_max; and
the mean stiffness is at most 40 % of K_max.

See docs/modes.md.
"""

from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np

from makebreak.diagrams.changing_contact import Knowledge, learned, telemetry
from makebreak.diagrams.changing_surface import (
    ChangingSurfaceConfig,
    SurfaceTask,
    constant_stiffness,
    make_changing_surface,
    make_task,
    surface_at,
)
from makebreak.diagrams.given_pattern import segment_paths
from makebreak.diagrams.recorder import recorded
from makebreak.diagrams.tabletop import THREE_SURFACES, read_model
from makebreak.scripts.experiments.runs.contact_runs import rehearsed, simulate_motion
from makebreak.scripts.experiments.runs.pattern_file import read_pattern
from makebreak.scripts.runner.comparison import Comparison
from makebreak.scripts.runner.criteria import Criteria
from makebreak.scripts.runner.session import Session
from makebreak.scripts.runner.table import Table
from makebreak.systems.changing_contact.numerics.contact_task import (
    CHANGE_TIME,
    COUNT,
    DECIDED_TIME,
    DONE,
    IS_NEW,
    PHASE_STAGE,
    TO_MODE,
)

SUMMARY = "a block slides over three unknown surfaces: contact modes (CC fig. 9, 10)"
Config = ChangingSurfaceConfig

DURATION_SEC = 200.0  # At most.
KNOWN_SEC, NEW_SEC = 0.15, 0.25  # From the end of a seam to the decision.
STIFFNESS_SHARE = 0.4  # Of K_max.
SETTLED_SEC = 0.3  # After the touch; before, there is an impact.
EARLY_SEC = 0.05  # A report this long before a seam begins still counts as its [s].
BENCH = {
    "block": {"baselines": False},
    "sphere": {"tool": "sphere", "baselines": False},
}


@dataclass(frozen=True)
class Change:
    """A change of surface, and what the mode detector reported of it."""

    before: int  # Numbers of the surfaces.
    after: int
    begins: float  # When the first foot leaves the old surface [s].
    centre: float  # When the tip is over the seam [s].
    ends: float  # When the last foot is on the new surface [s].
    new: bool  # Whether the new surface is met for the first time.
    right: bool = False  # Whether one report came, of the right mode.
    mode: int = 0  # The reported mode; 0: no report.
    decided: float = np.nan  # When it was reported [s].
    felt: float = np.nan  # When, by the report, the change began [s].
    confidence: tuple[float, float] = (np.nan, np.nan)


def run(config: ChangingSurfaceConfig, session: Session) -> dict:
    """The motion with adaptive and with constant stiffness, scored."""
    task = task_of(config)
    stiffness = config.control.variable_impedance.stiffness
    configs = {}
    if config.baselines:
        for label, value in (("k_free", stiffness.free), ("k_max", stiffness.maximum)):
            configs[label] = constant_stiffness(config, value)
    configs["adaptive"] = config  # Last, because Meshcat's recording shows the last.
    logs, done = {}, {}

    def simulate(knowledge, _, label, config=config, task=task):
        diagram = make_changing_surface(config, task, knowledge, session.meshcat)
        return simulate_motion(session, diagram, DURATION_SEC, label)

    known = Knowledge(contacts=task.prior)
    knowledge = rehearsed(config, task, simulate, known)
    for label, its in configs.items():
        log = simulate(knowledge, 0, label, config=its)
        done[label] = log["phase"][-1, PHASE_STAGE] == DONE
        logs[label] = telemetry(log.diagram, log.context)
        if label == "adaptive":
            recording = recorded(log.diagram, log.context)
            known = learned(log.diagram, log.context)
            if known.modes is not None and known.models is not None:
                known.modes.save(session.path("modes.json"))
                known.models.save(session.path("models.json"))
    main = logs["adaptive"]
    changes, surplus = changes_of(main, task.feet, config.rehearse > 0)
    session.save_plot(plot_modes(main, changes, task), "modes")
    session.save_plot(plot_stiffness(logs, changes), "stiffness")
    session.write_recording(recording, task.model)
    return summary(logs, done, changes, surplus, task, stiffness.maximum)


def task_of(config: ChangingSurfaceConfig) -> SurfaceTask:
    """The task, of the shipped motion or of a user's.

    Raises: ValueError in one line for a motion that cannot be followed.
    """
    if not config.pattern:
        return make_task(config)
    given = read_pattern(
        config.pattern, read_model(config.model, THREE_SURFACES, config.tool)
    )
    try:
        path = np.concatenate(segment_paths(given))
        if len(np.unique(surface_at(path, 0.0))) < 2:
            raise ValueError("it crosses no seam, expected a path over two surfaces")
        return make_task(config, given)
    except ValueError as error:
        raise ValueError(f"pattern {config.pattern}: {error}") from None


def pressing(log) -> np.ndarray:
    """(n,) whether the motion presses on something."""
    return np.any(log["force_directions"] != 0.0, axis=1)


def sliding(log) -> np.ndarray:
    """(n,) whether the block slides on the surfaces, its first touch settled."""
    on = pressing(log)
    if not on.any():
        return on
    return on & (log["time"] >= log["time"][np.argmax(on)] + SETTLED_SEC)


def modes_of(log) -> set[int]:
    """The modes that were found in sliding; not all of a rehearsal need be."""
    found = sliding(log) & (log["collecting"][:, 0] < 0.5)
    return {int(mode) for mode in log["mode"][found, 0] if mode >= 1}


def tracking_error(log) -> np.ndarray:
    """(n,) distance of the tip from its reference, within the surface [m]."""
    return np.linalg.norm((log["x_desired"] - _padded(log["ee_pose"]))[:, :2], axis=1)


def _padded(pose):
    return np.pad(pose, ((0, 0), (0, 12)))


def changes_of(log, feet: float, rehearsed: bool = False) -> tuple[list[Change], int]:
    """Every true change of surface in a log, with the report that belongs to it.

    Args: rehearsed, whether modes were known before: then a surface that is met for the
        first time may be one of them, if no other surface has it.
    Returns: the changes; the number of reports that belong to none or came twice.
    """
    time, p = log["time"], log["ee_pose"][:, :3]
    on = pressing(log)
    stands = surface_at(p, feet)
    here = surface_at(p, 0.0)[:, 0]
    whole = np.where((stands == stands[:, :1]).all(axis=1), stands[:, 0], 0)
    rows = np.flatnonzero(on & (whole > 0))
    found: list[Change] = []
    met = {int(whole[rows[0]])} if rows.size else set()
    for i, j in zip(rows[:-1], rows[1:], strict=True):
        if whole[i] == whole[j]:
            continue
        centre = i + int(np.argmax(here[i : j + 1] == whole[j]))
        found.append(
            Change(
                int(whole[i]),
                int(whole[j]),
                time[i],
                time[centre],
                time[j],
                new=int(whole[j]) not in met,
            )
        )
        met.add(int(whole[j]))
    transition = log["transition"]
    events = np.flatnonzero(np.diff(transition[:, COUNT]) > 0) + 1
    # The mode of the first surface is identified after the touch.
    names: dict[int, int] = {}
    if found:
        first = time.searchsorted(found[0].begins)
        names[found[0].before] = int(log["mode"][max(first - 1, 0), 0])
    surplus = len(events)
    for k, change in enumerate(found):
        until = found[k + 1].begins if k + 1 < len(found) else np.inf
        mine = [
            e
            for e in events
            if change.begins - EARLY_SEC <= transition[e, DECIDED_TIME] < until
        ]
        if not mine:
            continue
        surplus -= 1
        event = transition[mine[-1]]
        mode, is_new = int(event[TO_MODE]), bool(event[IS_NEW])
        if change.new:
            right = (is_new or rehearsed) and mode not in names.values()
            names[change.after] = mode
        else:
            right = mode == names.get(change.after)
        found[k] = Change(
            **{
                **vars(change),
                "right": right and len(mine) == 1,
                "mode": mode,
                "decided": float(event[DECIDED_TIME]),
                "felt": float(event[CHANGE_TIME]),
                "confidence": tuple(log["confidence"][mine[-1]].tolist()),
            }
        )
    return found, surplus


def summary(logs, done, changes, surplus, task: SurfaceTask, k_max: float) -> dict:
    """result.json."""
    main = logs["adaptive"]
    new = [c for c in changes if c.new]
    known = [c for c in changes if not c.new]

    def most(rows, since):
        delays = [c.decided - getattr(c, since) for c in rows]
        return float(np.nanmax(delays)) if np.isfinite(delays).any() else np.nan

    confidence = np.array([c.confidence for c in changes]).reshape(-1, 2)
    result: dict = {
        "success": False,
        "friction": task.friction.tolist(),
        "changes": len(changes),
        "changes_right": sum(c.right for c in changes),
        "changes_surplus": surplus,
        "modes": len(modes_of(main)),
        "confidence_min": float(np.fmin.reduce(confidence[:, 0], initial=np.nan)),
        "confidence_second_max": float(
            np.fmax.reduce(confidence[:, 1], initial=np.nan)
        ),
    }
    for name, rows in (("known", known), ("new", new)):
        result[f"delay_{name}_max_s"] = most(rows, "ends")
        result[f"delay_{name}_from_centre_max_s"] = most(rows, "centre")
    for label, log in logs.items():
        error = tracking_error(log)[sliding(log)]
        K = log["stiffness"][sliding(log), :2]
        if not len(error):  # A run that ended before the block slid.
            error, K = np.full(1, np.nan), np.full((1, 2), np.nan)
        result[f"tracking_error_rms_m_{label}"] = float(np.sqrt(np.mean(error**2)))
        result[f"tracking_error_max_m_{label}"] = float(error.max())
        result[f"stiffness_mean_Npm_{label}"] = float(K.mean())
        result[f"done_{label}"] = bool(done[label])
    share = result["stiffness_mean_Npm_adaptive"] / k_max
    result["stiffness_share"] = float(share)
    surfaces = len({c.after for c in changes} | {c.before for c in changes[:1]})
    right, modes = result["changes_right"], result["modes"]
    criteria = Criteria()
    criteria.holds("done", "every motion is carried out", all(done.values()))
    criteria.holds(
        "right", "changes recognised, and surplus ones; modes",
        0 < right == len(changes) and surplus == 0 and modes == surfaces,
        f"{right}, {surplus}; {modes}", f"{len(changes)}, 0; {surfaces}",
    )  # fmt: skip
    known_sec, new_sec = result["delay_known_max_s"], result["delay_new_max_s"]
    criteria.holds(
        "delay", "longest delay of a decision, known and new surfaces",
        known_sec <= KNOWN_SEC and new_sec <= NEW_SEC,
        f"{known_sec:.3g} s, {new_sec:.3g} s", f"at most {KNOWN_SEC} s, {NEW_SEC} s",
    )  # fmt: skip
    if "k_max" in logs:
        criteria.at_most(
            "tracking", "tracking error, rms; beside that with K_max",
            result["tracking_error_rms_m_adaptive"],
            result["tracking_error_rms_m_k_max"], "m",
        )  # fmt: skip
    criteria.at_most(
        "stiffness", "mean stiffness over K_max", float(share), STIFFNESS_SHARE
    )
    return result | criteria.result()


COLORS = {1: "#86a57f", 2: "#9a9a9a", 3: "#b98b5e"}


def _shade(ax, log, feet):
    """The surface that the tip is on, as a colour."""
    here = surface_at(log["ee_pose"][:, :3], 0.0)[:, 0]
    on = pressing(log)
    for surface, color in COLORS.items():
        ax.fill_between(
            log["time"], 0, 1, where=on & (here == surface), color=color, alpha=0.25,
            lw=0, transform=ax.get_xaxis_transform(), label=f"surface {surface}",
        )  # fmt: skip


def plot_modes(log, changes: list[Change], task: SurfaceTask):
    """Figure 9: modes with confidences, and the feature that they rest on."""
    figure, axes = plt.subplots(
        2, 1, figsize=(12, 6.5), sharex=True, layout="constrained"
    )
    time = log["time"]
    R = np.maximum(log["wrench"][:, 2], 1.0)
    feature = np.linalg.norm(log["wrench"][:, :2], axis=1) / R
    keep = slice(None, None, 5)
    for ax in axes:
        _shade(ax, log, task.feet)
        for change in changes:
            ax.axvline(change.ends, color="#c44e52", lw=0.8)
    axes[0].plot(time[keep], feature[keep], lw=0.6, color="0.25")
    for surface, mu in enumerate(task.friction, start=1):
        axes[0].axhline(mu, color=COLORS[surface], lw=1.2, ls="--")
    axes[0].set(ylabel="|F_t| / R; dashed: friction", ylim=(0, 0.8))
    axes[0].legend(loc="upper left", ncols=3, fontsize=8)
    axes[1].plot(time, log["mode"][:, 0], color="C0")
    most = log["mode"].max()
    for change in changes:
        if not np.isfinite(change.decided):
            continue
        best, second = change.confidence
        text = f"{best:.2f}" + (" N" if change.new else "")
        axes[1].annotate(text, (change.decided, most + 0.35), color="#2e7d32",
                         ha="center", fontsize=8)  # fmt: skip
        axes[1].annotate(f"{second:.2f}", (change.decided, most + 0.1), color="#c44e52",
                         ha="center", fontsize=8)  # fmt: skip
    axes[1].set(
        ylabel="mode (-1: not known yet, 0: free)",
        xlabel="time [s]; red lines: the block is wholly on another surface",
        ylim=(-1.3, most + 0.7),
        yticks=range(-1, int(most) + 1),
    )
    axes[1].set_title(
        "green: confidence (N: new), red: second best", fontsize=9, loc="right"
    )
    return figure


def plot_stiffness(logs, changes: list[Change]):
    """Figure 10: stiffness and tracking error."""
    figure, axes = plt.subplots(
        2, 1, figsize=(12, 6), sharex=True, layout="constrained"
    )
    colors = {"adaptive": "C0", "k_max": "C3", "k_free": "C7"}
    for label, log in logs.items():
        rows = sliding(log)
        time = log["time"][rows]
        error = 1e3 * tracking_error(log)[rows]
        rms = np.sqrt(np.mean(error**2))
        axes[0].plot(time, log["stiffness"][rows, 0], color=colors[label], lw=1.0)
        axes[1].plot(
            time, error, color=colors[label], lw=0.9, label=f"{label}: rms {rms:.2f} mm"
        )
    for ax in axes:
        for change in changes:
            ax.axvspan(change.begins, change.ends, color="0.85", lw=0)
    axes[0].set(ylabel="stiffness [N/m]", ylim=(0, None))
    axes[1].set(
        ylabel="tracking error [mm]",
        yscale="log",
        ylim=(0.01, None),
        xlabel="time [s]; grey: the block stands on two surfaces",
    )
    axes[1].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    return figure


VARIANTS: dict[str, dict] = {
    "sphere": {"tool": "sphere"},
    "0.05 m/s, 5 N": {"speed": 0.05, "normal_force": 5.0},
    "0.2 m/s, 12 N": {"speed": 0.2, "normal_force": 12.0},
    "one model for all modes": {"control.forward_model.per_mode": False},
}


def reproduce(session: Session, seeds: int, jobs: int) -> Table:
    """Figures 9 and 10 beside ours, over seeds; another tool, other speeds."""
    comparison = Comparison("changing_surface", session, jobs)
    row = comparison.row

    def many(settings, n):
        results = comparison.runs(settings, n)
        return results, [r for r in results if "changes" in r]

    main, ended = many({}, seeds)
    if not ended:
        raise RuntimeError(f"no run ended: {main[0].get('error')}")

    def recognised(results, ended):
        n, right = (sum(r[k] for r in ended) for k in ("changes", "changes_right"))
        surplus = sum(r["changes_surplus"] for r in ended)
        text = f"{right} of {n}, {surplus} reported too many"
        if len(ended) < len(results):
            text += f"; {len(results) - len(ended)} runs failed"
        good = right - surplus >= 0.98 * n and len(ended) == len(results)
        return text, good

    def most(key, runs=ended):
        return float(max(r[key] for r in runs))

    text, good = recognised(main, ended)
    row("fig. 9: changes recognised", "all of one trial", text, good)
    row("fig. 9: confidence, least", "high", min(r["confidence_min"] for r in ended))
    row(
        "fig. 9: confidence of the second best, most",
        "much lower",
        most("confidence_second_max"),
    )
    modes = sum(r["modes"] != 3 for r in ended)
    row("runs with more or fewer modes than surfaces", "0", modes, modes == 0)
    for kind, bound in (("known", KNOWN_SEC), ("new", NEW_SEC)):
        value = most(f"delay_{kind}_max_s")
        centre = most(f"delay_{kind}_from_centre_max_s")
        row(
            f"delay of a {kind} mode, most",
            "known much shorter than new",
            f"{value:.3f} s (from the tip's crossing {centre:.3f} s)",
            value <= bound,
        )

    def errors(label, runs=ended):
        rms = 1e3 * np.array([r[f"tracking_error_rms_m_{label}"] for r in runs])
        peak = 1e3 * np.array([r[f"tracking_error_max_m_{label}"] for r in runs])
        return (
            rms,
            f"{rms.mean():.2f} mm (worst seed {rms.max():.2f}; {peak.max():.1f})",
        )

    ours, text = errors("adaptive")
    stiff, stiff_text = errors("k_max")
    row(
        "fig. 10: tracking error rms (worst; peak), adaptive",
        "low, peaks at changes",
        text,
        bool(np.all(ours <= stiff)),
    )
    row("the same, constant K_max", "-", stiff_text)
    row("the same, constant K_free", "-", errors("k_free")[1])
    share = 100 * np.array([r["stiffness_share"] for r in ended])
    row(
        "fig. 10: mean stiffness, share of K_max",
        "low but after changes",
        f"{share.mean():.0f} % (most {share.max():.0f} %)",
        bool(np.all(share <= 100 * STIFFNESS_SHARE)),
    )
    for label, settings in VARIANTS.items():
        settings = {**settings, "baselines": False}
        results, runs = many(settings, max(1, seeds // 2))
        its = comparison.with_settings(settings)
        if not runs:
            row(label, "-", "no run ended", False, command=its)
            continue
        text, good = recognised(results, runs)
        row(f"{label}: changes recognised", "-", text, good, command=its)
        delays = [f"{most(f'delay_{k}_max_s', runs):.3f}" for k in ("known", "new")]
        row(
            f"{label}: delay of a known, a new mode, most",
            "-",
            " / ".join(delays) + " s",
            command=its,
        )
        row(f"{label}: tracking error", "-", errors("adaptive", runs)[1], command=its)
    return comparison.to_table(
        "Three unknown surfaces (CC 4.3, figures 9 and 10)",
        [
            "Delays count from when the last foot of the block is across. The paper "
            "shows one trial on a robot and gives no numbers but confidences.",
        ],
    )
