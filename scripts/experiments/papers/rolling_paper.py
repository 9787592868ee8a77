"""`makebreak reproduce ball_rolling`: the paper's results for its objects, and ours."""

import numpy as np
from scipy.stats import t as student

from makebreak.diagrams.camera import vtk_works
from makebreak.scripts.experiments.papers.rolling_score import CIRCLES
from makebreak.scripts.runner.comparison import Rows
from makebreak.scripts.runner.sweep import rate_text
from makebreak.scripts.runner.table import Table
from makebreak.scripts.runner.trials import run_many

# The tracker works equally well on drawn images as on VTK's, whose rendering takes most
# of the time of a run; a few seeds with VTK show that.
DRAWN = {"camera.renderer": "drawn"}
RADIUS_ERRORS = (-0.008, -0.005, 0.0, 0.005, 0.008, 0.012)  # Both signs [m].
FRUIT = ("orange", "lime")
PUSHES = 10  # Of the paper, "within around 10 pushing trials for errors up to 8 mm".
FORCE_MAX = 40.0  # [N]


def cases() -> dict[str, dict]:
    """{name: settings} of the runs that are made with each seed."""
    found: dict[str, dict] = {}
    for error in RADIUS_ERRORS:
        for adapt in (True, False):
            name = f"{'adapt' if adapt else 'no adaptation'}, {1e3 * error:+.0f} mm"
            found[name] = {"adapt": adapt, "radius_error_m": error}
    ours = {"adapt": True, "radius_error_m": 0.005}
    found["the paper's controller, +5 mm"] = ours | {"controller": "paper"}
    for learner in ("r_dyn", "both"):
        found[f"learner={learner}, +5 mm"] = ours | {"learner": learner}
    for projection in ("qp", "exact"):
        found[f"projection={projection}, +5 mm"] = ours | {"projection": projection}
    for fruit in FRUIT:
        one = {"object": fruit}
        found[f"{fruit}, adapt, +3 mm"] = one | ours | {"radius_error_m": 0.003}
        for error in (0.003, 0.0):
            found[f"{fruit}, no adaptation, {1e3 * error:+.0f} mm"] = one | {
                "adapt": False,
                "radius_error_m": error,
            }
    return {name: settings | DRAWN for name, settings in found.items()}


VTK_SEEDS = 3


def conditions(seed):
    """Random settings from the ranges in which the controller should work."""
    rng = np.random.default_rng([seed, 1])
    return {
        "adapt": True,
        "radius_error_m": round(float(rng.uniform(0.003, 0.008)), 5),
        "friction": round(float(rng.uniform(0.3, 0.8)), 3),
        "rolling_resistance": round(float(rng.uniform(0.002, 0.02)), 4),
        "ball_noise_m": round(float(rng.uniform(0.0, 0.002)), 5),
    } | DRAWN


def no_worse(adapted, frozen) -> bool:
    """Whether adaptation is not worse: at least as many runs complete four circles, and
    the mean error is not significantly larger (paired by seed, 95 %)."""
    done = [sum(r.get("circles_completed", 0) >= CIRCLES for r in g)
            for g in (adapted, frozen)]  # fmt: skip
    pairs = [
        (a["tracking_error_mean_m"], f["tracking_error_mean_m"])
        for a, f in zip(adapted, frozen, strict=True)
        if a.get("tracking_error_mean_m") is not None
        and f.get("tracking_error_mean_m") is not None
    ]
    if done[0] < done[1]:
        return False
    if len(pairs) < 2:
        return all(a <= f for a, f in pairs)
    more = np.subtract(*np.transpose(pairs))
    spread = float(np.std(more, ddof=1)) / np.sqrt(len(more))
    return bool(more.mean() <= student.ppf(0.975, len(more) - 1) * spread)


def adaptive_targets() -> dict:
    """{text: test of a result} of the targets of an adaptive run; events that did not
    occur are None in a result, and miss their targets."""
    return {
        "four circles, mean error <= 4 mm": lambda r: r["success"],
        "first contact within 8 s": (
            lambda r: (r["time_to_first_contact_s"] or np.inf) <= 8.0
        ),
        "r_comp within 2 mm of the gap": (
            lambda r: abs(r["r_gap_error_m"] or np.inf) <= 2e-3
        ),
        f"a quarter circle within {PUSHES} pushes": (
            lambda r: (r["pushes_to_quarter_circle"] or np.inf) <= PUSHES
        ),
        f"peak force <= {FORCE_MAX:.0f} N": (
            lambda r: r["contact_force_peak_N"] <= FORCE_MAX
        ),
    }


def reproduce(session, seeds, jobs) -> Table:
    """The paper's results for ball and fruits, and ours over seeds 0 .. seeds - 1 with
    the camera in the loop; ours under random conditions; both signs of an error."""
    named = cases()
    trials = [(settings, s) for settings in named.values() for s in range(seeds)]
    trials += [(conditions(s), s) for s in range(seeds)]
    if vtk_works():
        vtk = {"adapt": True, "radius_error_m": 0.005, "camera.renderer": "vtk"}
        trials += [(vtk, s) for s in range(min(seeds, VTK_SEEDS))]
    results = run_many(
        "ball_rolling", trials, jobs, session.out_dir, reuse=session.reuse
    )
    names = [*named, "adapt, random conditions"]
    group = {n: results[i * seeds : (i + 1) * seeds] for i, n in enumerate(names)}
    rendered = results[len(names) * seeds :]
    failed = [r for r in results if "error" in r]
    table = Rows("makebreak reproduce ball_rolling")

    def add(what, paper, ours, goal=None):
        if failed and goal:
            goal = False  # Runs that ended in an error do not count as met.
        table.row(what, paper, ours, goal)

    def count(runs, test):
        return sum(bool(test(r)) for r in runs if "error" not in r)

    def add_rate(what, paper, runs, test, share=None):
        n = count(runs, test)
        goal = None if share is None else n >= share * len(runs)
        add(what, paper, rate_text(n, len(runs)), goal)

    def add_spread(what, paper, runs, key, scale=1.0, unit=""):
        values = [r[key] * scale for r in runs if r.get(key) is not None]
        text = "-"
        if values:
            text = f"{np.mean(values):.2f} {unit} "
            text += f"({min(values):.2f} .. {max(values):.2f})"
            if len(values) < len(runs):
                text += f", {len(values)} runs"
        add(what, paper, text)

    def four_circles(r):
        return r["success"]

    def add_adaptive(name, share, paper_done="-", paper_time="-"):
        runs = group[name]
        tests = adaptive_targets()
        add_rate(f"{name}: all of", paper_done, runs,
                 lambda r: all(test(r) for test in tests.values()), share)  # fmt: skip
        for what, test in tests.items():
            add_rate(f"{name}: {what}", "-", runs, test)
        for what, key, scale, unit, paper in (
            ("time to four circles", "time_to_circles_s", 1.0, "s", paper_time),
            ("first contact", "time_to_first_contact_s", 1.0, "s", "-"),
            ("pushes to a quarter circle", "pushes_to_quarter_circle", 1.0, "", "-"),
            ("mean error", "tracking_error_mean_m", 1e3, "mm", "-"),
            ("95 % of the error", "tracking_error_p95_m", 1e3, "mm", "-"),
            ("r_comp - gap, last circle", "r_gap_error_m", 1e3, "mm", "-"),
            ("90 % interval of r_comp holds the gap", "r_gap_covered_share", 100, "%",
             "-"),
            ("contact force peak", "contact_force_peak_N", 1.0, "N", "-"),
            ("loss, first 6 s (Fig. 6)", "residual_loss_first", 1.0, "", "falls"),
            ("loss, last 6 s (Fig. 6)", "residual_loss_last", 1.0, "", "falls"),
        ):  # fmt: skip
            add_spread(f"{name}: {what}", paper, runs, key, scale, unit)

    papers = {0.005: ("done (1 run shown)", "315 s"), 0.008: ("~10 pushes", "-")}
    for error in RADIUS_ERRORS:
        sign = f"{1e3 * error:+.0f} mm"
        share = 1.0 if error in (0.0, 0.005, 0.008) else 0.95
        add_adaptive(f"adapt, {sign}", share, *papers.get(error, ("-", "-")))
        frozen = group[f"no adaptation, {sign}"]
        started = "no (1 run)" if error == 0.005 else "-"
        add_rate(f"no adaptation, {sign}: started rolling", started, frozen,
                 lambda r: r["initiated"])  # fmt: skip
        add_rate(f"no adaptation, {sign}: four circles, mean error <= 4 mm", "-",
                 frozen, four_circles)  # fmt: skip
        for what, key, scale, unit in (
            ("mean error", "tracking_error_mean_m", 1e3, "mm"),
            ("contact force peak", "contact_force_peak_N", 1.0, "N"),
        ):
            add_spread(f"no adaptation, {sign}: {what}", "-", frozen, key, scale, unit)
        better = no_worse(group[f"adapt, {sign}"], frozen)
        add(f"{sign}: adapting is no worse than not", "-", "yes" if better else "no",
            better)  # fmt: skip
    add_adaptive("adapt, random conditions", 0.95)
    for name in named:
        if "controller" in name or "learner=" in name or "projection=" in name:
            runs = group[name]
            add_rate(f"{name}: started rolling", "-", runs, lambda r: r["initiated"])
            add_rate(f"{name}: four circles, mean error <= 4 mm", "-", runs,
                     four_circles)  # fmt: skip
            add_spread(f"{name}: mean error", "-", runs, "tracking_error_mean_m", 1e3,
                       "mm")  # fmt: skip
    for fruit in FRUIT:
        rates = {
            f"{fruit}, adapt, +3 mm": (
                "90 %", 0.95, "70 %" if fruit == "orange" else "50 %",
                0.9 if fruit == "orange" else 0.8,
            ),
            f"{fruit}, no adaptation, +3 mm": ("0 %", None, "0 %", None),
            f"{fruit}, no adaptation, +0 mm": ("-", None, "-", None),
        }  # fmt: skip
        for name, (start, start_goal, circle, circle_goal) in rates.items():
            add_rate(f"{name}: started", start, group[name],
                     lambda r: r["initiated"], start_goal)  # fmt: skip
            add_rate(f"{name}: one circle", circle, group[name],
                     lambda r: r["one_circle"], circle_goal)  # fmt: skip
            add_spread(f"{name}: mean error", "-", group[name],
                       "tracking_error_mean_m", 1e3, "mm")  # fmt: skip
    if rendered:
        name = "adapt, +5 mm, pictures by VTK"
        add_rate(f"{name}: four circles, mean error <= 4 mm", "-", rendered,
                 four_circles, 1.0)  # fmt: skip
        add_spread(f"{name}: mean error", "-", rendered, "tracking_error_mean_m", 1e3,
                   "mm")  # fmt: skip
    notes = [
        "Pictures of 320x240 at 80 Hz, drawn with OpenCV where VTK is not named.",
        "Ours: mean (least .. largest) over the seeds, rates with Wilson's 95 % "
        "interval, in simulation; the paper's are hardware runs.",
        "+ is a model that is too large. Random conditions: radius error 3-8 mm, "
        "friction 0.3-0.8, rolling resistance 0.002-0.02, camera noise 0-2 mm.",
        "Fruits: a new one per seed; of its shape the model has a radius, 3 mm more "
        "than its mean one or just that.",
    ]
    notes += [f"seed {r['seed']} failed: {r['error']}" for r in failed]
    return table.to_table(
        "Rolling a ball and fruits that are modelled wrongly (ACI-MPC VII-B, VII-C)",
        notes,
    )
