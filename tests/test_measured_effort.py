"""Windows of logs in which efforts were measured and nothing was commanded."""

from types import SimpleNamespace

import numpy as np
import pytest
from effect_scenes import J, double, pendulum, with_effects
from scipy.signal import lfilter

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.table import write_recording
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.residuals.mechanism import MechanismProblem
from makebreak.gap.simulation.windows import WindowModel, seen_in
from makebreak.models.dynamics import SceneDynamics

SIZE, RATE = 2.0, 8.0  # [N m], [rad/s] of a sine.
ENCODER = 1e-5  # [rad]


def windows(folder, noise, hz=50.0, seconds=20.0, slow=0.0, known=True):
    """Of a joint that a sine of effort swings about its middle, without gravity.
    slow [N m]: of the effort's noise that lasts for 3 s; known: to the windows."""
    scene = pendulum(folder, gravity=0.0)
    rng = np.random.default_rng(0)
    time = np.arange(0.0, seconds, 1.0 / hz)
    position = -SIZE / (J * RATE**2) * np.sin(RATE * time)
    columns = {
        "time": time,
        "p.j1.position": position + ENCODER * rng.normal(size=len(time)),
        "p.j1.effort_measured": SIZE * np.sin(RATE * time)
        + noise * rng.normal(size=len(time))
        + slow * lasting(len(time), np.exp(-1.0 / (3.0 * hz)), rng),
    }
    said = {"p.j1.position": ENCODER, "p.j1.effort_measured": max(noise, 1e-4)}
    write_recording(folder / "run.csv", columns, noise=said)
    recordings = read_recordings([folder / "run.csv"])
    return WindowModel(scene, recordings, slow_noise={"p.j1": slow if known else 0.0})


def test_when_an_effort_jumps_between_two_rows_is_not_known(tmp_path):
    """Efforts that are switched at random, 50 rows a second: windows with a jump are
    off by its time, and no more than they expect."""
    scene, rng, fine = pendulum(tmp_path, gravity=0.0), np.random.default_rng(3), 1e-4
    time = np.arange(0.0, 60.0, fine)
    switched = np.searchsorted(np.cumsum(rng.uniform(0.8, 1.2, 80)), time)
    level = SIZE * rng.uniform(-1.0, 1.0, 81)[switched]
    level -= level.mean()
    rate = np.cumsum(level / J) * fine
    rate -= rate.mean()
    rows = slice(None, None, 200)
    columns = {
        "time": time[rows],
        "p.j1.position": np.cumsum(rate)[rows] * fine
        + ENCODER * rng.normal(size=len(time[rows])),
        "p.j1.effort_measured": level[rows],
    }
    said = {"p.j1.position": ENCODER, "p.j1.effort_measured": 1e-4}
    write_recording(tmp_path / "run.csv", columns, noise=said)
    model = WindowModel(scene, read_recordings([tmp_path / "run.csv"]))
    errors = model.errors(model.simulate(()))
    y = columns["p.j1.effort_measured"]
    jumped = [
        e for e, w in zip(errors, model.windows, strict=True) if np.ptp(y[w.rows]) > 0.2
    ]
    assert 30 < len(jumped) < 100
    assert 0.4 < np.sqrt(np.mean(np.square(np.concatenate(jumped)))) < 1.3


@pytest.mark.parametrize("more", [0.03, 0.5])
def test_masses_of_a_joint_at_rest_are_known_to_their_tolerance(tmp_path, more):
    """Friction may hold it, so its equation says next to nothing of masses, 1.5 kg to
    within 3 %; windows of a good encoder show any. They expect that, but no more."""
    scene = double(tmp_path)
    heavier = ("link_mass", "d.upper", {"mass": more})
    dynamics = SceneDynamics(with_effects(scene, heavier))
    time = np.arange(0.0, 20.0, 0.01)
    zero, w = np.zeros_like(time), 5.0
    q, v, a = (
        np.column_stack([still, swings])
        for still, swings in (
            (zero + 1.2, np.sin(w * time)),
            (zero, w * np.cos(w * time)),
            (zero, -(w**2) * np.sin(w * time)),
        )
    )
    columns, said, rng = {"time": time}, {}, np.random.default_rng(0)
    needed = dynamics.inverse_dynamics(q, v, a, time)
    for i, joint in enumerate(("d.j1", "d.j2")):
        columns[f"{joint}.position"] = q[:, i] + ENCODER * rng.normal(size=len(time))
        columns[f"{joint}.effort_measured"] = needed[:, i]
        said |= {f"{joint}.position": ENCODER, f"{joint}.effort_measured": 1e-4}
    write_recording(tmp_path / "run.csv", columns, noise=said)
    problem = MechanismProblem(scene, read_recordings([tmp_path / "run.csv"]))
    n = problem.nuisances()
    screen = Screen(problem.base(), n.columns, n.prior, problem.train(), reach=n.reach)
    b, left = screen.fit_nuisances(problem.base())
    fitted = SimpleNamespace(b=b, left=left, r=problem.base())
    assert problem.error(fitted) < 1.0
    outcome = problem.outcome([], fitted, fitted, n)
    is_known = "known to within their tolerance" in outcome.expects
    assert (outcome.gap.before < 2.0) == is_known == (more < 0.1)


def lasting(n, keep, rng):
    """(n,) of unit variance, of which a share `keep` lasts from row to row."""
    return lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.normal(size=n))


def test_a_measured_effort_is_a_line_between_rows_and_is_not_held(tmp_path):
    model = windows(tmp_path, 0.0)
    off = np.concatenate(
        [seen_in(model, w) - y
         for w, y in zip(model.windows, model.simulate(()), strict=True)]
    )  # fmt: skip
    # Held, it would come half a row late: SIZE/J * 0.01 s, for 0.3 s, is 0.02 rad.
    # In steps of 5 ms a line is off by (RATE 5 ms)^2/24 of the motion; the start's
    # velocity by 1e-3 rad/s or less.
    assert np.sqrt(np.mean(off**2)) < 4e-4


@pytest.mark.parametrize("noise", [0.1, 0.4])
def test_noise_of_a_measured_effort_is_expected_in_the_windows(tmp_path, noise):
    model = windows(tmp_path, noise, seconds=60.0)
    e = np.concatenate(model.errors(model.simulate(())))
    # 180 windows, of which each counts as one or two; the smoother's own error beside.
    assert np.sqrt(np.mean(e**2)) == pytest.approx(1.0, abs=0.2)
    # It is the effort's: the encoder and the start alone would be a third of it.
    last = np.array([w.std[-1, 0] for w in model.windows])
    t = 0.28  # Some windows have a row less.
    expected = noise / J * np.sqrt(t**3 / 3.0 / 50.0)
    assert (last > 0.95 * expected).all() and np.median(last) < 2.0 * expected


def test_noise_of_a_measured_effort_that_lasts_is_expected_in_the_windows(tmp_path):
    rms = {}
    for known in (True, False):
        model = windows(tmp_path, 0.1, seconds=120.0, slow=0.5, known=known)
        e = np.concatenate(model.errors(model.simulate(())))
        rms[known] = np.sqrt(np.mean(e**2))
    # 120 s have some 20 independent values of it.
    assert rms[True] == pytest.approx(1.0, abs=0.3)
    assert rms[False] > 2.0 * rms[True]
