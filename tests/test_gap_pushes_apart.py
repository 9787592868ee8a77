"""Objects that are pushed for short whiles: their size, short touches, long runs."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from gap_benchmark import push_world
from gap_benchmark.push_world import BLOCK, TIP
from push_problems import pushed_problem, screen_of
from scipy.interpolate import PchipInterpolator
from scipy.sparse import csr_matrix
from test_gap_statistics import TwoChannels

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.fit import fit_effects
from makebreak.gap.numerics.permitted_forces import held_means, test_functions
from makebreak.gap.problem import Candidate, SearchPlan
from makebreak.gap.residuals.contact_means import ContactMeans
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.residuals.permitted_contacts import STEADY, PermittedContacts
from makebreak.gap.search.screen import rank
from makebreak.gap.search.select import select
from makebreak.gap.simulation.contact_shapes import Slot
from makebreak.gap.simulation.contact_windows import BEFORE_SEC, PushWindows
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene

test_functions.__test__ = False  # type: ignore[attr-defined]


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.93, 1.06])
def test_an_object_s_size_is_measured_by_where_it_is_pushed(tmp_path, scale):
    """The block is so many times as large as the scene's, with the same mass."""
    rng = np.random.default_rng(71)
    world = push_world.a_world(rng)
    truth = replace(
        world, half=tuple(scale * x for x in world.half), foot=scale * world.foot
    )
    problem = pushed_problem(tmp_path, world, truth, rng, 5)
    screen = screen_of(problem)
    start = Effect("object_size", [BLOCK], {"scale": 1.0})
    end = fit_effects(problem, screen, [start])
    assert end.effects[0].parameters["scale"] == pytest.approx(scale, abs=0.01)
    assert end.score < 0.6 * fit_effects(problem, screen, []).score
    # What held-out rows allow, not what the slope at the end says.
    wide = problem.widened(replace(end, std=({"scale": 1e-9},)), 0)[0]["scale"]
    assert 0.5 * abs(end.effects[0].parameters["scale"] - scale) < wide < 0.03
    assert wide > 1e-4
    (found,) = [
        c for c in problem.candidates(
            problem.nuisances(), fit_effects(problem, screen, [])
        )
        if c.kind == "object_size"
    ]  # fmt: skip
    assert found.at == (BLOCK,)


def test_means_of_different_widths_are_those_of_each_width():
    t = np.sort(np.random.default_rng(0).uniform(0.0, 1.0, 300))
    centres, halves = np.array([0.2, 0.5, 0.8]), np.array([0.05, 0.1, 0.15])
    both = test_functions(t, centres, halves)
    held = held_means(t, centres, halves)
    for k, half in enumerate(halves):
        for found, one in zip(
            (*both, held),
            (*test_functions(t, centres[[k]], half), held_means(t, centres[[k]], half)),
            strict=True,
        ):
            np.testing.assert_allclose(found[[k]].toarray(), one.toarray())


def short_touches(spans, centres, felt=True, struck=()):
    """Centres and half widths for touches from and to given times, of a second."""
    t = np.arange(0.0, 1.0, 0.005)
    on = np.zeros(len(t), bool)
    for a, b in spans:
        on |= (t >= a) & (t < b)
    hit = np.zeros(len(t), bool)
    for x in struck:
        hit |= np.abs(t - x) < 0.004
    means = SimpleNamespace(
        half=0.2, _least_half=0.1, _touching={(1, 2): on}, _is_struck=lambda rows: hit,
        _apart={(1, 2): on} if felt else {},
    )  # fmt: skip
    track = SimpleNamespace(time=t)
    return ContactMeans._with_short_touches(
        means, track, slice(0, len(t)), np.array(centres, float)
    )


def test_a_touch_that_is_too_short_for_a_test_function_has_one_of_its_own():
    centres, halves = short_touches([(0.1, 0.4), (0.6, 0.7)], [0.85])
    # 0.3 s long; the second one, of 0.1 s, holds too few samples of a camera.
    np.testing.assert_allclose(centres, [0.2475, 0.85])
    np.testing.assert_allclose(halves, [0.1475, 0.2])
    # One that lasts has test functions as they are; if it holds none, a whole one.
    assert len(short_touches([(0.1, 0.9)], [0.4])[0]) == 1
    np.testing.assert_allclose(short_touches([(0.1, 0.6)], [0.85])[1], [0.2, 0.2])
    # What no sensor feels may touch or not; an impact ends what goes before.
    assert len(short_touches([(0.1, 0.4)], [], felt=False)[0]) == 0
    centres, halves = short_touches([(0.1, 0.7)], [], struck=[0.4])
    np.testing.assert_allclose(centres, [0.2475, 0.55])
    # From 0.1 to 0.395 s; from 0.405 s, after the struck row, to 0.695 s.
    np.testing.assert_allclose(halves, [0.1475, 0.145])


@pytest.mark.parametrize(("rate", "sure"), [(200.0, True), (1000.0, False)])
def test_a_step_of_an_effort_between_rows_is_not_known_to_the_row(rate, sure):
    """Rows at 200 Hz of commands at 200 Hz hold; of five commands one is seen."""
    t, centres = np.arange(0.0, 1.0, 0.005), np.array([0.3, 0.5])
    u = np.where(t < 0.5, 0.0, 3.0)
    means = SimpleNamespace(
        scene=SimpleNamespace(actuation=SimpleNamespace(rate_hz=rate))
    )  # fmt: skip
    log = SimpleNamespace(held=lambda name: u)
    track = SimpleNamespace(time=t, episode=SimpleNamespace(rows=slice(None)))
    phi = SimpleNamespace(track=track, recording=log, centres=centres)
    held = held_means(t, centres, 0.1)
    mean, var, rate = ContactMeans._commanded_effort(means, "j", phi, held)
    # By which a late command is corrected: half of the step in 0.2 s.
    np.testing.assert_allclose(rate, (mean[1] - mean[0]) / 0.2)
    assert mean[0] == pytest.approx(0.0, abs=1e-9) and rate[0] > 5.0
    np.testing.assert_allclose(mean, [0.0, 1.5], atol=0.02)
    assert var[0] == 0.0 and (var[1] == 0.0) == sure
    if not sure:
        # A step of 3 N m, at a time that is uniform within 5 ms, where the weight of a
        # test function is at its most, (315/256)/half.
        assert np.sqrt(var[1]) == pytest.approx(
            3.0 * 0.005 / np.sqrt(12.0) * 315.0 / 256.0 / 0.1, rel=0.1
        )


@pytest.mark.parametrize(("turn", "drops"), [(0.05, False), (0.3, True)])
def test_a_mean_in_which_a_normal_turns_is_left_out(turn, drops):
    angle = np.linspace(-turn, turn, 5)
    normal = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(5)])
    assert (np.linalg.norm(normal.mean(axis=0)) < STEADY) == drops
    slot = Slot(1, 2, (0, 0), np.zeros(5), normal, np.zeros((5, 3)), np.ones(5, bool),
                0.5, 1e5)  # fmt: skip
    contacts = SimpleNamespace(
        means=SimpleNamespace(time=np.zeros(1)), slots=[slot],
        _masks=[np.ones(5, bool)], _W=csr_matrix(np.full((1, 5), 0.2)),
    )  # fmt: skip
    assert PermittedContacts._turning(contacts).tolist() == [drops]
    contacts._masks = [np.zeros(5, bool)]  # It does not act.
    assert PermittedContacts._turning(contacts).tolist() == [False]


@pytest.mark.slow
def test_a_long_recording_is_simulated_from_push_to_push(tmp_path, monkeypatch):
    """Pushed three times in nine seconds: windows begin before each of the pushes, with
    the tip away, and elsewhere; a short episode has two as before."""
    knots = [0.0, 0.3, 1.5, 2.3, 3.3, 4.6, 5.4, 6.4, 7.6, 9.0]
    places = [0.0, 0.0, 0.06, 0.03, 0.03, 0.10, 0.07, 0.07, 0.14, 0.14]
    way = PchipInterpolator(knots, places)

    def path(rng, seconds, rate):
        t = np.arange(int(seconds * rate)) / rate
        return t, way(t), way(t, 1)

    monkeypatch.setattr(push_world, "_path", path)
    rng = np.random.default_rng(4)
    world = push_world.a_world(rng)

    def windows(seconds):
        table, noise = push_world.record(world, rng, episodes=1, seconds=seconds)
        scene = push_world.write(tmp_path, world, table, noise)
        recordings = read_recordings([tmp_path / "recording.csv"])
        return PushWindows(read_scene(scene), recordings), table

    made, table = windows(9.0)
    starts = np.array(sorted(w.start for w in made.windows))
    assert 5 <= len(starts) <= 10
    t, x = table["time"], table[f"{BLOCK}.x"]
    seen = np.isfinite(x)
    t, p = t[seen], np.column_stack([x, table[f"{BLOCK}.y"]])[seen]
    gone = np.linalg.norm(p - p[:20].mean(axis=0), axis=1)
    for begin in (3.3, 6.4):  # The tip sets out again; the block moves later.
        rest = gone[(t > begin - 0.3) & (t < begin)].mean()
        moves = t[(t > begin) & (gone > rest + 2e-3)][0]
        before = starts[(starts > begin - 0.4) & (starts < moves)]
        assert len(before) and moves - before[-1] < BEFORE_SEC + 0.25
    error = np.concatenate(made.errors(made.simulate(())))
    assert np.sqrt(np.nanmean(error**2)) < 1.5
    # A window is no surer than it is in the other model, and as sure in its own.
    slippery = Effect("contact_friction", [f"{BLOCK}~{TIP}"], {"friction": 1e-3})
    for effects, changes in (((), False), ((slippery,), True)):
        wider = [w.std for w in made.with_spread_of(effects).windows]
        more = [b - w.std for b, w in zip(wider, made.windows, strict=True)]
        assert min(m.min() for m in more) >= 0.0
        assert (max(m.max() for m in more) > 1e-5) == changes
    assert len(windows(2.6)[0].windows) <= 2


@dataclass(frozen=True)
class Spread:
    """A window of which only the deviation counts."""

    std: np.ndarray


def test_what_starts_do_in_another_model_is_added_to_a_deviation_in_squares():
    known, more = [np.array([7.0, 2.0])], [np.array([23.0, 1.0])]
    made = SimpleNamespace(
        windows=[Spread(np.array([3.0, 3.0]))], _wide=known,
        _spread=lambda effects: (None, more),
    )  # fmt: skip
    (window,) = PushWindows.with_spread_of(made, ()).windows
    np.testing.assert_allclose(window.std, [5.0, 3.0])


class TwoAtOnce(TwoChannels):
    """Damping and a bias are the truth; a drag alone imitates both better than either
    does, and a friction is the bias but for a trifle."""

    plan = SearchPlan(least_gain=0.05, most_effects=3)

    def __init__(self):
        super().__init__(damping=0.0, bias=0.0)
        rest, a, b, other, trifle = np.random.default_rng(8).normal(
            size=(5, len(self._base))
        )
        a, b, other, trifle = (30.0 * x for x in (a, b, other, trifle))
        self._of = {
            "joint_viscous_damping": a, "actuator_bias": b,
            "joint_quadratic_drag": a + b + 0.3 * other,
            "joint_coulomb_friction": b + 0.001 * trifle,
        }  # fmt: skip
        self._base = rest + 0.1 * a + 0.1 * b

    def candidates(self, nuisances, current):
        names = {"joint_viscous_damping": "damping", "actuator_bias": "bias",
                 "joint_quadratic_drag": "coefficient",
                 "joint_coulomb_friction": "coulomb"}  # fmt: skip
        return [
            Candidate(kind, ("a.j",), 1, (self._of[kind][:, None],),
                      (lambda c, name=name: {name: float(c[0])},))
            for kind, name in names.items()
        ]  # fmt: skip


def test_two_effects_that_were_added_at_once_have_ties_too():
    found = {
        c.effect.kind: [t.kind for t in c.ties] for c in select(TwoAtOnce()).choices
    }
    assert "joint_viscous_damping" in found and len(found) == 2
    assert found["joint_viscous_damping"] == []
    (one,) = set(found) - {"joint_viscous_damping"}
    assert {one, *found[one]} == {"actuator_bias", "joint_coulomb_friction"}


def test_a_jump_is_no_slope():
    """Of three moments with two rows each: alike both ways but for curvature; one way
    another face is met; both ways, which contradict each other."""
    moments = SimpleNamespace(_of_moments=lambda: np.repeat([0, 1, 2], 2))
    ahead = np.array([10.0, -3.0, 9e3, 2.0, 5e3, 1.0])
    back = np.array([11.0, -2.0, 40.0, 3.0, -4e3, 1.5])
    found = ContactProblem._without_jumps(moments, ahead, back, 0.01)  # type: ignore
    np.testing.assert_array_equal(found, [10.0, -3.0, 40.0, 2.0, 0.0, 1.0])


def test_a_block_of_one_moment_is_less_loud_than_one_of_many():
    blocks = SimpleNamespace(
        _block=np.array([0] * 8 + [1]), blocks=lambda: np.repeat([0, 1], [80, 10])
    )
    left = np.full(90, 4.0)
    (many, _), (one, _) = ContactProblem._blocks_left(blocks, left)  # type: ignore
    assert many == pytest.approx(4.0 * np.sqrt(8 / 9))
    assert one == pytest.approx(4.0 * np.sqrt(1 / 2))


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.4, 2.5])
def test_a_friction_far_off_is_guessed_by_steps_as_far(tmp_path, factor):
    """What more friction changes ends where the tip sticks: by small steps half of what
    is missing is found."""
    rng = np.random.default_rng(73)
    world = push_world.a_world(rng)
    truth = replace(world, tip_friction=factor * world.tip_friction)
    problem = pushed_problem(tmp_path, world, truth, rng, 5)
    screen = screen_of(problem)
    found = problem.candidates(problem.nuisances(), fit_effects(problem, screen, []))
    (one,) = [r for r in rank(screen, found) if r.candidate.at == (f"{BLOCK}~tip.tip",)]
    guess = one.effects[0].parameters["friction"]
    assert guess == pytest.approx(truth.tip_friction, rel=0.15)


def test_a_body_that_drake_cannot_scale_has_no_size_to_name(tmp_path):
    """It is seen as a mesh; a simulation with another size would end in an error."""
    rng = np.random.default_rng(71)
    world = push_world.a_world(rng)
    table, noise = push_world.record(world, rng, episodes=1)
    scene = push_world.write(tmp_path, world, table, noise)
    recordings = read_recordings([tmp_path / "recording.csv"])
    for sized in (True, False):
        if not sized:
            (tmp_path / "seen.obj").write_text("v 0 0 0\nv .1 0 0\nv 0 .1 0\nf 1 2 3\n")
            (file,) = tmp_path.glob("block*.sdf")
            seen = "<visual name='v'><geometry><mesh><uri>seen.obj</uri></mesh>"
            text = file.read_text().replace(
                "</link>", f"{seen}</geometry></visual></link>"
            )
            file.write_text(text)
        problem = ContactProblem(read_scene(scene), recordings)
        kinds = {trial[0] for trial in problem._trials()}
        assert ("object_size" in kinds) == sized and "object_mass" in kinds


def test_a_recording_of_too_few_means_is_refused(tmp_path):
    rng = np.random.default_rng(71)
    world = push_world.a_world(rng)
    table, noise = push_world.record(world, rng, episodes=1, seconds=1.0)
    scene = push_world.write(tmp_path, world, table, noise)
    with pytest.raises(ValueError, match="too little motion"):
        ContactProblem(read_scene(scene), read_recordings([tmp_path / "recording.csv"]))


def test_a_slip_that_may_be_the_smoother_s_may_stick(tmp_path):
    """One that is known sure presses along its slip; else a pyramid of ways is free."""
    rng = np.random.default_rng(71)
    world = push_world.a_world(rng)
    problem = pushed_problem(tmp_path, world, world, rng, 3)

    def ways(times: float) -> int:
        problem._node_v_off = times * known
        masks = dict(zip((s.key for s in problem.slots), problem._masks, strict=True))
        columns = problem._columns(problem.slots, problem._node_poses, masks)
        return sum(int(c.can.sum()) for c in columns)

    known = problem._node_v_off.copy()
    assert known.shape == problem._node_v.shape and np.abs(known).max() > 0.0
    assert ways(0.0) < ways(1.0) < ways(1e3)
