"""Which motion to record: one that tells named parameters of a scene best.

The parameters are those of effects (docs/effects.md) that the scene may lack; how they
enter the measured efforts is their signature. The motion keeps the joints' limits; the
search is in numerics/excitation.py. Not looked at: whether the robot meets itself or
its surroundings on the way.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from makebreak.gap.numerics.excitation import (
    DesignProblem,
    Excitation,
    Limits,
    Series,
    design,
)
from makebreak.models.drives import law_of
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import (
    actuator_of,
    full_name,
    one_dof_joints,
    sliding_joints,
    unit_at,
)
from makebreak.models.effects.signature import Motion
from makebreak.models.effects.sizes import range_of
from makebreak.models.model_files import couplings_of, robot_files
from makebreak.models.scene import Scene
from makebreak.models.typed_yaml import nearest

# Kinds that URDF and MJCF have numbers for: of joints friction and rotors, of links
# masses and centres of mass, which are nuisances where they are not named.
JOINTS = tuple(n for n, k in KINDS.items() if k.at == "joint" and k.exported)
LINKS = tuple(
    n for n, k in KINDS.items()
    if k.at == "body" and k.exported and not k.absolute
    and not any(p.optional for p in k.parameters)
)  # fmt: skip
PLACES = ("joint", "actuator", "body", "base")
TURN = np.pi  # [rad] To each side, of a joint without limits of position.
# A parameter that a log leaves at this share of what was known before is not told.
UNTOLD = 0.5


@dataclass(frozen=True)
class LogPlan:
    """How the log is to be recorded.

    seconds: its length, of whole periods. rate_hz: its samples. noise: standard
    deviation of a sample of a measured effort, as a share of the joint's limit, white.
    velocity, acceleration, effort: {joint, or "": of all} limits that take the place of
    the model's [rad/s, rad/s2, N m; of sliding joints in metres and newtons].
    """

    seconds: float = 20.0
    period: float = 10.0
    harmonics: int = 5
    rate_hz: float = 100.0
    noise: float = 0.01
    velocity: Mapping[str, float] = field(default_factory=dict)
    acceleration: Mapping[str, float] = field(default_factory=dict)
    effort: Mapping[str, float] = field(default_factory=dict)


_USUAL = LogPlan()


@dataclass(frozen=True)
class Predicted:
    """A parameter, and its standard deviation before the log and after it."""

    kind: str
    at: str
    name: str
    unit: str
    before: float
    after: float

    @property
    def is_told(self) -> bool:
        """Whether the log will narrow the parameter down."""
        return self.after < UNTOLD * self.before


@dataclass(frozen=True, eq=False)
class DesignedLog:
    """joints: in the order of the motion's columns. model: (q, v, vd) -> the effort
    that the scene's model needs."""

    joints: tuple[str, ...]
    excitation: Excitation
    limits: Limits
    plan: LogPlan
    predicted: tuple[Predicted, ...]
    model: Callable

    def columns(self) -> dict[str, np.ndarray]:
        """The commands of the whole log by channel, as of a recording."""
        plan = self.plan
        n = round(_periods(plan) * plan.period * plan.rate_hz) + 1
        time = np.arange(n) / plan.rate_hz
        q, v, vd = self.excitation.at(time)
        found = {"time": time}
        for name, value in (
            ("position", q), ("velocity", v), ("effort", self.model(q, v, vd)),
        ):  # fmt: skip
            for j, joint in enumerate(self.joints):
                found[f"{joint}.{name}_command"] = value[:, j]
        return found


class LogDesign:
    """The design problem of a scene.

    Args: named: `KIND` or `KIND@PLACE`; none: friction, rotors, and masses and centres
        of mass of the links. plan: see LogPlan.
    Raises: ValueError for what cannot be named, a mechanism that is not joints alone,
        all of them driven, or a limit that is missing.
    """

    def __init__(self, scene: Scene, named: Sequence[str] = (), plan: LogPlan = _USUAL):
        self.plan = plan
        self.dynamics = SceneDynamics(scene)
        plant = self.dynamics.plant
        joints = sorted(one_dof_joints(plant), key=lambda j: j.velocity_start())
        self.joints = tuple(full_name(plant, joint) for joint in joints)
        loose = [name for name in self.joints if name not in scene.actuation.joints]
        if loose or plant.num_velocities() != len(joints):
            raise ValueError(
                "a log is designed for joints that turn or slide and are all driven; "
                f"not driven: {', '.join(loose) or 'a free body'} (fixed_joints of the "
                "scene holds a joint)"
            )
        tied = [f"{a} follows {b}" for a, b in couplings_of(scene).items()
                if a in self.joints]  # fmt: skip
        if tied:
            raise ValueError(
                f"a log is designed for joints that move alone: {', '.join(tied)} "
                "(fixed_joints of the scene holds both)"
            )
        self.limits = _limits(scene, plant, joints, self.joints, plan)
        self.named = _named(self.dynamics, named)
        others = [(kind, at) for kind in LINKS for at in self.dynamics.links()]
        self.places = [*self.named, *(o for o in others if o not in self.named)]
        self.parameters, prior = self._parameters(scene)
        count = sum(1 for p in self.parameters if (p[0], p[1]) in self.named)
        self.problem = DesignProblem(
            self.regressor, Series(plan.period, plan.harmonics), self.limits,
            plan.noise * self.limits.effort, prior, count,
            _periods(plan) * plan.period * plan.rate_hz,
        )  # fmt: skip

    def effort(self, q, v, vd) -> np.ndarray:
        """(n, n_joints) that the model needs."""
        return self.dynamics.inverse_dynamics(q, v, vd)

    def regressor(self, q, v, vd) -> tuple[np.ndarray, np.ndarray]:
        """Columns (n, n_joints, k) of all parameters, and the effort."""
        effort = self.effort(q, v, vd)
        motion = Motion(np.zeros(len(q)), q, v, vd, effort)
        columns = [
            self.dynamics.signatures(kind, [at], motion)[0].columns
            for kind, at in self.places
        ]
        return np.concatenate(columns, axis=2), effort

    def _parameters(self, scene: Scene):
        """(kind, at, name, unit) of each column, and the (k,) standard deviation that
        is known of it: of a nuisance its tolerance, else half its range."""
        still = np.zeros((1, len(self.joints)))
        motion = Motion(np.zeros(1), still, still, still, still)
        masses, found, prior = self.dynamics.links(), [], []
        slides = sliding_joints(self.dynamics.plant)
        for kind, at in self.places:
            known = {p.name: p for p in KINDS[kind].parameters}
            for name in self.dynamics.signatures(kind, [at], motion)[0].unknowns:
                p = known.get(name)
                size = np.inf
                if p is not None:
                    size = 0.5 * float(np.ptp(range_of(p, [at], self.dynamics.sizes)))
                if kind in LINKS and p is not None and p.unit == "kg":
                    size = masses[at]
                if (kind, at) not in self.named:
                    size = _tolerance(scene, kind, masses[at])
                prior.append(size)
                unit = _unit(name) if p is None else unit_at(p.unit, at in slides)
                found.append((kind, at, name, unit))
        return found, np.array(prior)

    def predicted(self, excitation: Excitation) -> tuple[Predicted, ...]:
        """Of each named parameter, by a log of this motion."""
        after = self.problem.deviations(excitation)
        return tuple(
            Predicted(who[0], who[1], who[2], who[3], float(before), float(sd))
            for who, before, sd in zip(
                self.parameters, self.problem.prior, after, strict=True
            )
            if who[:2] in self.named
        )

    def solve(self, progress: Callable[[str], None] = lambda text: None) -> DesignedLog:
        """The best motion. Raises: ValueError if none is within the limits."""
        found = design(self.problem, progress=progress)
        return DesignedLog(
            self.joints, found, self.limits, self.plan, self.predicted(found),
            self.effort,
        )  # fmt: skip


def _unit(name: str) -> str:
    """Of a coefficient that is no parameter of its kind: those of a payload."""
    return "kg m" if name.startswith("mass_com") else "kg m2" if name[0] == "i" else ""


def _periods(plan: LogPlan) -> int:
    return max(1, round(plan.seconds / plan.period))


def _tolerance(scene: Scene, kind: str, mass: float) -> float:
    """How well a link is known: as an object whose own value has the same unit."""
    (known,) = {
        k.tolerance
        for k in KINDS.values()
        if k.tolerance is not None and k.absolute
        and k.parameters[0].unit == KINDS[kind].parameters[0].unit
    }  # fmt: skip
    share = scene.tolerance.get(known.key, known.default)
    return share * mass if known.relative else share


def _named(dynamics: SceneDynamics, words: Sequence[str]) -> list[tuple[str, str]]:
    found: list[tuple[str, str]] = []
    for word in words or (*JOINTS, *LINKS):
        kind, _, at = word.partition("@")
        if kind not in KINDS:
            raise ValueError(f"--for: no kind {kind}; {nearest(kind, KINDS)}")
        places = dynamics.places(kind) if KINDS[kind].at in PLACES else []
        if kind in LINKS:
            places = [place for place in places if place in dynamics.links()]
        if not places or not _is_linear(dynamics, kind, places[0]):
            raise ValueError(
                f"--for: {kind} is not linear in the efforts of this scene; expected "
                f"one as {', '.join((*JOINTS, *LINKS))}"
            )
        if at and at not in places:
            raise ValueError(f"--for: {kind} cannot be at {at}; {nearest(at, places)}")
        found += [(kind, place) for place in ([at] if at else places)]
    return list(dict.fromkeys(found))


def _is_linear(dynamics: SceneDynamics, kind: str, at: str) -> bool:
    """Whether one signature without held values says it, at each instant alone."""
    if KINDS[kind].path in ("lag", "delay"):
        return False
    n = dynamics.plant.num_velocities()
    still = np.zeros((2, n))
    signatures = dynamics.signatures(
        kind, [at], Motion(np.arange(2.0), still, still, still, still)
    )
    return len(signatures) == 1 and not (signatures[0].held or signatures[0].channels)


def _effort_limits(scene: Scene) -> dict[str, float]:
    """{<model>.<joint>: effort limit of its file}: Drake keeps none of a URDF's joint
    that has no transmission."""
    return {
        f"{model}.{joint}": limit
        for model, file in robot_files(scene).items()
        for joint, limit in file.limits.items()
    }


def _limits(scene: Scene, plant, joints, names, plan: LogPlan) -> Limits:
    def given(what: str, k: int, own: float) -> float:
        values = getattr(plan, what)
        return float(values.get(names[k], values.get("", own)))

    of_files = _effort_limits(scene)
    for what in ("velocity", "acceleration", "effort"):
        for name in getattr(plan, what):
            if name and name not in names:
                raise ValueError(f"--{what}: no joint {name}; {nearest(name, names)}")
    rows = []
    for k, joint in enumerate(joints):
        lower, upper = joint.position_lower_limit(), joint.position_upper_limit()
        turns = joint.type_name() == "revolute"
        if not np.isfinite([lower, upper]).all() and turns:
            lower, upper = max(lower, -TURN), min(upper, TURN)
        actuator, law = actuator_of(plant, joint), law_of(scene.actuation, names[k])
        effort = np.inf if actuator is None else actuator.effort_limit()
        effort = min(effort, np.inf if law is None else float(law.limit))
        effort = effort if np.isfinite(effort) else of_files.get(names[k], np.inf)
        row = {
            "lower": lower,
            "upper": upper,
            "velocity": given("velocity", k, joint.velocity_upper_limits()[0]),
            "acceleration": given(
                "acceleration", k, joint.acceleration_upper_limits()[0]
            ),
            "effort": given("effort", k, effort),
        }
        if not np.isfinite([lower, upper]).all():
            raise ValueError(f"{names[k]} has no limits of position in its model")
        rows.append(row)
    lacks = {
        what: [n for n, row in zip(names, rows, strict=True) if row[what] == np.inf]
        for what in ("velocity", "effort")
    }
    if any(lacks.values()):
        each = [f"{what} ({', '.join(of)})" for what, of in lacks.items() if of]
        options = " and ".join(f"--{what}" for what, of in lacks.items() if of)
        raise ValueError(
            f"the model has no limits of {' and '.join(each)}: give {options}, a "
            f"number for all joints or JOINT=NUMBER"
        )
    return Limits(**{key: np.array([row[key] for row in rows]) for key in rows[0]})
