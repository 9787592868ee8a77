"""Errors of the learned residual on small plants for which it was not tuned.

The world is Drake at 1 ms steps, moved by hand-written forces. The learner (a
posterior, velocities weighted with 1 cm/s, otherwise its defaults) reads sampled states
and inputs through its ports; its model has other sizes. The true gap is the difference
of Drake's signed distances in world and model. Errors are those of the second half of
each run.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from makebreak.benchmarks.plants import (
    DISC,
    FREE_BOX,
    FREE_CYLINDER,
    PUCK,
    SQUEEZED,
    Pushed,
    diagram_of,
)
from makebreak.diagrams.contact_mpc import ContactMpcConfig, make_contact_mpc
from makebreak.systems.contact_mpc.lcs_builder import AnitescuLcs
from makebreak.systems.contact_mpc.numerics.lcs import simulate
from makebreak.systems.contact_mpc.residual_learner import (
    AdamConfig,
    PosteriorConfig,
    ResidualLearner,
    ResidualLearnerConfig,
)

STEP = 1e-3  # Of the world [s].
WEIGHT = 1e4  # Of a velocity: 1 / (1 cm/s)^2.
WITHIN = 1.645  # Standard deviations of a 90 % interval.
ONE = (-12, -5, 0, 5, 12)  # Errors of one gap [mm],
SMALL = (-5, 0, 5)  # those of objects that stand on feet,
BOTH = (-6, 0, 6)  # one error for two contacts,
EACH = ((0, 0), (6, 6), (-6, -6), (6, -6), (6, 0))  # and one for each of two.


@dataclass(frozen=True)
class Sensor:
    """Errors of the measured states."""

    length_std: float = 0.0  # [m]
    velocity_std: float = 0.0  # [m/s]
    rounded: float = 0.0  # Lengths are multiples of this [m].
    late: float = 0.0  # Time by which states are late [s].
    outlier: float = 0.0  # Added to a velocity of every tenth sample [m/s],
    of: int | None = None  # that of this index of v; None: of a random one.
    lost: int = 0  # One sample of so many is NaN; 0: none.

    def read(self, x: np.ndarray, plant: Pushed, n_q: int) -> np.ndarray:
        """The measured states (n, n_x) of true ones."""
        rng, x = np.random.default_rng(0), x.copy()
        lengths = [i for i in range(n_q) if i not in plant.turned]
        n = len(x)
        x[:, lengths] += self.length_std * rng.normal(size=(n, len(lengths)))
        x[:, n_q:] += self.velocity_std * rng.normal(size=x[:, n_q:].shape)
        if self.rounded:
            x[:, lengths] = np.round(x[:, lengths] / self.rounded) * self.rounded
        wrong = np.arange(5, n, 10)
        of = rng.integers(n_q, x.shape[1], size=len(wrong))
        x[wrong, of if self.of is None else n_q + self.of] += self.outlier
        if self.lost:
            x[self.lost // 2 :: self.lost] = np.nan
        return x


@dataclass(frozen=True)
class Row:
    """The runs of one row of the table: all combinations.

    Args:
        what: the row's name.
        plants, periods, sensors: of the runs; periods in s.
        errors: of the gaps [mm]; a number, or one for each of two contacts.
        world: further settings of the world.
        learner: settings of the learner that differ.
        stiffness: of the first contact in the model [N/m]; None: rigid.
        adapting: how many of the wrong contacts adapt; None: all.
    """

    what: str
    plants: Sequence[Pushed]
    errors: Sequence
    periods: Sequence[float] = (0.05,)
    sensors: Sequence[Sensor] = (Sensor(),)
    world: Sequence[dict] = ({},)
    learner: dict = field(default_factory=dict)
    stiffness: float | None = None
    adapting: int | None = None


BY_GRADIENT = dict(posterior=None, adam=AdamConfig(n_steps=5))
ROWS = [
    Row("puck on a rail, 5 ms", [PUCK], ONE, [0.005]),
    Row("puck on a rail, 50 ms", [PUCK], ONE),
    Row("box between two fingers, 10 and 50 ms", [SQUEEZED], EACH, [0.01, 0.05]),
    Row("disc pressed on a table, 10 and 50 ms", [DISC], BOTH, [0.01, 0.05]),
    Row("free box and cylinder, pushed, 5 ms", [FREE_BOX, FREE_CYLINDER], SMALL,
        [0.005]),
    Row("free box and cylinder, pushed, 50 ms", [FREE_BOX, FREE_CYLINDER], SMALL),
    Row("free box of half or twice the mass or friction", [FREE_BOX], (-5, 5),
        world=[dict(mass=0.2), dict(mass=0.8), dict(mu=0.2), dict(mu=0.8)]),
    Row("puck and free box, noise 0.3 mm and 5 mm/s", [PUCK, FREE_BOX], (-5, 5),
        sensors=[Sensor(3e-4, 5e-3)]),
    Row("puck and free box, noise 1 mm and 20 mm/s", [PUCK, FREE_BOX], (-5, 5),
        sensors=[Sensor(1e-3, 2e-2)]),
    Row("puck and free box, states 20 and 50 ms late", [PUCK, FREE_BOX], (-5, 5),
        sensors=[Sensor(late=0.02), Sensor(late=0.05)]),
    Row("puck, positions in steps of 1 mm", [PUCK], ONE,
        sensors=[Sensor(rounded=1e-3)]),
    Row("puck of four times the damping", [PUCK], ONE, world=[dict(damping=20.0)]),
    Row("box between fingers, outliers of 1 m/s, 2 % lost", [SQUEEZED], [(6, -6)],
        sensors=[Sensor(velocity_std=5e-3, outlier=1.0, lost=50)]),
    *(Row(f"puck, {whose} velocity 5 m/s off in 10 %{how}", [PUCK], (-5, 5),
          sensors=[Sensor(outlier=5.0, of=of)], learner=learner)
      for how, learner in (("", {}), ("; gradient", BY_GRADIENT))
      for of, whose in enumerate(("the finger's", "its"))),
    Row("disc, the finger's residual alone", [DISC], (-6, 6), adapting=1),
    Row("free box, all velocities weighted",
        [replace(FREE_BOX, weighted=list(range(9)))], SMALL),
    Row("free box, stiffness 1 kN/m in the model", [FREE_BOX], (-5,), stiffness=1e3),
    *(Row(f"box between two fingers, {1e3 * dt:g} ms", [SQUEEZED], [(6, -6)], [dt])
      for dt in (0.001, 0.1, 0.2)),
]  # fmt: skip


@dataclass(frozen=True)
class Run:
    """What one run shows; arrays have a row for each step of the learner.

    Args: r, std, truth: gap by the residual, its deviation, and the true one, (n,
        contacts) [m]; before, after: weighted error (n - 1,) of the prediction of one
        step without and with the residual.
    """

    r: np.ndarray
    std: np.ndarray
    truth: np.ndarray
    before: np.ndarray
    after: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """Of the second half [m]."""
        return abs(self.r - self.truth)[len(self.r) // 2 :]

    @property
    def within(self) -> float:
        """Share of all steps in which the truth is in the 90 % interval."""
        return float(np.mean(abs(self.r - self.truth) <= WITHIN * self.std))

    @property
    def better(self) -> float:
        """How many times smaller the residual makes the error of the prediction."""
        half = len(self.before) // 2
        a, b = (np.nanmean(e[half:] ** 2) for e in (self.before, self.after))
        return float(np.sqrt(a / b))

    @property
    def was_wrong(self) -> bool:
        return bool(abs(self.truth).max() > 1e-4)


@cache
def record(text: str, plant: Pushed, seconds: float, start: tuple | None = None):
    """States (n, n_x) and inputs (n, n_u) of a world at each of its steps. Args: start:
    x; None: the plant's own."""
    diagram, body = diagram_of(text, STEP)
    simulator = Simulator(diagram)
    context = body.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    first = plant.start if start is None else np.array(start)
    if first is not None:
        body.SetPositionsAndVelocities(context, first)
    states, inputs = [], []
    for k in range(round(seconds / STEP)):
        x = body.GetPositionsAndVelocities(context).copy()
        u = plant.drive(k * STEP, x)
        body.get_actuation_input_port().FixValue(context, u)
        states.append(x)
        inputs.append(u)
        simulator.AdvanceTo((k + 1) * STEP)
    return np.array(states), np.array(inputs)


def distances(text: str, plant: Pushed, states) -> np.ndarray:
    """Signed distance (n, contacts) [m] of the learned contacts at states (n, n_x)."""
    diagram, body = diagram_of(text)
    context = diagram.CreateDefaultContext()
    own = body.GetMyMutableContextFromRoot(context)
    shapes = [
        [body.GetCollisionGeometriesForBody(body.GetBodyByName(name)) for name in pair]
        for pair in plant.bodies
    ]
    found = []
    for x in states:
        body.SetPositionsAndVelocities(own, x)
        query = body.get_geometry_query_input_port().Eval(own)
        distance = query.ComputeSignedDistancePairClosestPoints
        found.append(
            [min(distance(a, b).distance for a in A for b in B) for A, B in shapes]
        )
    return np.array(found)


def runs(row: Row) -> Iterator[Run]:
    """The runs of a row."""
    for plant in row.plants:
        for errors in row.errors:
            each = 1e-3 * np.array(
                errors if isinstance(errors, tuple) else 2 * [errors]
            )
            for more in row.world:
                world = plant.world(each, **more)
                for period in row.periods:
                    for sensor in row.sensors:
                        yield run(row, plant, [world], period, sensor)


def run(row: Row, plant: Pushed, worlds: Sequence[str], period, sensor) -> Run:
    """The learner on one recording.

    Args: worlds: SDF texts, each for an equal part of the recording; period [s].
    """
    right = plant.world(np.zeros(2))
    pairs = list(plant.pairs)
    pairs[0] = replace(pairs[0], stiffness=row.stiffness)
    model = AnitescuLcs(diagram_of(right)[0], pairs, period)
    n = row.adapting or len(plant.bodies)
    lcs = model.at_default()
    Q_d = np.zeros(model.n_x)
    Q_d[[model.n_q + i for i in plant.weighted]] = WEIGHT
    groups = [np.flatnonzero(lcs.contact == k).tolist() for k in range(n)]
    settings = dict(Q_d=Q_d.tolist(), eps=1e-3, groups=groups)
    settings["posterior"] = PosteriorConfig()
    config = ResidualLearnerConfig(**settings | row.learner)
    learner = ResidualLearner(config, lcs, period)

    parts, start = [], None
    for world in worlds:
        parts.append(record(world, plant, plant.seconds / len(worlds), start))
        start = tuple(parts[-1][0][-1])
    X, U = (np.vstack(each) for each in zip(*parts, strict=True))
    every = round(period / STEP)
    at = np.arange(0, len(X), every)
    part = len(at) // len(worlds)  # Of the learner's steps, in each world.
    late = np.maximum(at - round(sensor.late / STEP), 0)
    measured = sensor.read(X[late], plant, model.n_q)
    applied = [U[max(i - every, 0) : max(i, 1)].mean(axis=0) for i in at]

    simulator = Simulator(learner)
    context = simulator.get_mutable_context()
    r: list[np.ndarray] = []
    std, before, after = [], [], []
    for k, (x, u) in enumerate(zip(measured, applied, strict=True)):
        if k:
            step = lcs, measured[k - 1], u, x
            before.append(miss(*step, np.zeros(model.n_lam), Q_d))
            after.append(miss(*step, r[-1], Q_d))
        if np.isfinite(x).all():
            lcs = model.build(x, u)
        for name, value in (("x", x), ("u_measured", u), ("lcs", lcs)):
            learner.GetInputPort(name).FixValue(context, value)
        simulator.AdvanceTo((k + 0.5) * period)  # Past its update at k period.
        r.append(learner.GetOutputPort("r_comp").Eval(context).copy())
        std.append(learner.GetOutputPort("r_std").Eval(context).copy())
    true = np.vstack([
        distances(world, plant, X[at[k * part : (k + 1) * part]])
        for k, world in enumerate(worlds)
    ])  # fmt: skip
    truth = (true - distances(right, plant, X[at]))[:, :n]
    first = [group[0] for group in groups]
    return Run(
        period * np.array(r)[:, first], period * np.array(std), truth,
        np.array(before), np.array(after),
    )  # fmt: skip


def miss(lcs, x, u, x_next, r, Q_d) -> float:
    """Weighted error of the prediction of one step under the residual r; NaN where the
    states were lost."""
    if not np.isfinite([*x, *x_next]).all():
        return np.nan
    predicted, _ = simulate(lcs.with_residual(r), x, u)
    return float(np.sqrt(Q_d @ (predicted - x_next) ** 2))


def span(values: Sequence[float], unit: str = "") -> str:
    """The least and the largest value as text."""
    ends = min(values), max(values)
    low, high = (f"{x:.0f}" if x >= 9.5 else f"{x:.2g}" for x in ends)
    return f"{low}-{high}{unit}" if low != high else f"{low}{unit}"


def summary(what: str, found: Sequence[Run]) -> dict:
    """A row of the table: the worst root mean square and the largest error of all
    runs; in which part of the steps the truth is in the 90 % interval; and how many
    times smaller the residual makes the prediction's error, with a wrong and with a
    right model."""
    inside = [100.0 * run.within for run in found]
    wrong = [run.better for run in found if run.was_wrong]
    right = [run.better for run in found if not run.was_wrong]
    learned = found[0].std.any()  # The gradient has no deviation.
    return {
        "what": what,
        "value": 1e3 * max(float(np.sqrt(np.mean(run.error**2))) for run in found),
        "unit": "mm rms",
        "largest_mm": 1e3 * max(float(run.error.max()) for run in found),
        "in_90": span(inside, " %") if learned else None,
        "better": span(wrong) if wrong else None,
        "right_model": span(right) if right else None,
    }


def changed() -> list[dict]:
    """A face of the box between two fingers that moves by 6 mm in the middle."""
    worlds = [SQUEEZED.world(error) for error in ((0.0, 0.0), (6e-3, 0.0))]
    found = run(Row("", [], []), SQUEEZED, worlds, 0.05, Sensor())
    return [
        {
            "what": f"box between two fingers, {sec:g} s after a face moved by 6 mm",
            "value": 1e3 * float(found.error[round(sec / 0.05)].max()),
            "unit": "mm",
        }
        for sec in (0.5, 1.0)
    ]


def in_the_loop(error: float, learns: bool) -> dict:
    """C3 pushes the puck to 0.5 m, as in examples/push_a_wrong_puck.py.

    Args: error: of its radius in the model [m]; learns: whether C3 gets the residual.
    """
    Q, goal, dt = [0.0, 200.0, 1.0, 20.0], [0.4, 0.5, 0.0, 0.0], 0.05
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, STEP)
    Parser(plant).AddModelsFromString(PUCK.world((error,)), "sdf")
    plant.Finalize()
    model = diagram_of(PUCK.world((0.0,)))[0]
    config = ContactMpcConfig(PUCK.pairs, Q, [0.01], goal, period_sec=dt)
    mpc = builder.AddSystem(make_contact_mpc(model, config))
    lcs = AnitescuLcs(model, PUCK.pairs, dt).at_default()
    learning = ResidualLearnerConfig(
        Q_d=[0.0, 0.0, WEIGHT, WEIGHT], eps=1e-3, groups=[[0, 1, 2, 3]],
        posterior=PosteriorConfig(),
    )  # fmt: skip
    learner = builder.AddSystem(ResidualLearner(learning, lcs, dt, offset_sec=5e-5))
    for system in (mpc, learner):
        builder.Connect(plant.get_state_output_port(), system.GetInputPort("x"))
    u = mpc.GetOutputPort("u")
    builder.Connect(u, plant.get_actuation_input_port())
    builder.Connect(u, learner.GetInputPort("u_measured"))
    builder.Connect(mpc.GetOutputPort("lcs"), learner.GetInputPort("lcs"))
    if learns:
        r_comp = learner.GetOutputPort("r_comp")
        builder.Connect(r_comp, mpc.GetInputPort("r_comp"))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(4.0)
    context = simulator.get_context()
    place = plant.GetPositions(plant.GetMyContextFromRoot(context))[1]
    own = learner.GetMyContextFromRoot(context)
    r = dt * learner.GetOutputPort("r_comp").Eval(own)[0]
    size = f"{1e3 * error:+g} mm" if error else "right"
    return {
        "what": f"puck to 0.5 m by C3, gap {size}{', learner' if learns else ''}",
        "value": float(place),
        "unit": "m",
        "largest_mm": float(1e3 * abs(r - error)) if learns else None,
    }


def rows() -> list[dict]:
    found = [summary(row.what, list(runs(row))) for row in ROWS]
    loops = [(e, learns) for e in (8e-3, -8e-3, 0.0) for learns in (False, True)]
    return found + changed() + [in_the_loop(*each) for each in loops]
