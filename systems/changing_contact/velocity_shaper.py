"""The velocity shaper: see numerics/velocity_shaper.py for how it re-times a motion."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, LeafSystem

from makebreak.systems.changing_contact.numerics.contact_regions import (
    N_REGIONS,
    expected,
)
from makebreak.systems.changing_contact.numerics.contact_task import (
    N_CONTACT,
    ContactBelief,
)
from makebreak.systems.changing_contact.numerics.motion_pattern import MotionPattern
from makebreak.systems.changing_contact.numerics.shaped_reference import (
    blended,
    pose_output,
)
from makebreak.systems.changing_contact.numerics.shaper_memory import (
    N_MEMORY,
    ShaperLaw,
    begin_anew,
)
from makebreak.systems.changing_contact.numerics.velocity_shaper import (
    plan,
    take_over,
    tick,
    warm_up,
)
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed


@dataclass
class RegionConfig:
    """Where an expected contact is approached slowly."""

    # Half width of the region of an expected contact, in standard deviations of its
    # place.
    sigmas: float = 2.0
    margin: float = 0.004  # Length that is added to the region at both ends [m].
    # Time at the approach speed v_a by which the region of an impact begins earlier
    # [s].
    settle_sec: float = 0.12
    # Time in which the base controller is blended into the transition-phase controller,
    # before the region's entry (eq. 10) [s].
    blend_sec: float = 0.1
    # Whether there are regions of expected contact; false: contacts are met at any
    # speed.
    anticipate: bool = True


@dataclass
class SearchConfig:
    """What is done where an expected contact does not come."""

    # Speed of the search for a contact beyond the end of the path, where none was
    # expected [m/s].
    speed: float = 0.05
    # Length beyond the end of the path over which a contact is searched for [m].
    distance: float = 0.1
    # Whether the motion goes on after a contact where none should be; false: it stops.
    go_on_unexpected: bool = False


@dataclass
class VelocityShaperConfig:
    """Settings of VelocityShaper."""

    # Largest acceleration along the path in a change of speed [m/s2].
    acceleration_max: float = 0.9
    speed_min: float = 0.004  # Least approach speed; a lower one is raised to it [m/s].
    # Time in which the pattern fades back to where it was planned, after a contact or
    # its loss has shifted it to where the tip is [s]; inf: it stays shifted.
    release_sec: float = np.inf
    region: RegionConfig = field(default_factory=RegionConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    period_sec: float = 0.001  # Period of the updates [s]; the diagram sets it.
    offset_sec: float = 0.0  # Time of the first update [s]; the diagram sets it.


@dataclass(frozen=True, eq=False)
class _Patterns:
    """The pattern that runs, and the one that it replaces from time t on, within T."""

    now: MotionPattern
    given: MotionPattern  # As the port had it.
    old: MotionPattern | None = None
    t: float = 0.0
    T: float = 0.0

    def __copy__(self):
        return self

    def __deepcopy__(self, _):
        return self


class VelocityShaper(LeafSystem):
    """A motion pattern whose speed is v_a where a contact is expected, C-infinity.

    The speed alone is changed; the tip stays on the pattern's path, shifted by what
    contacts have taught. A segment that ends in a contact ends when it comes: the next
    one starts at once. If it has not come at the end of the path, the motion goes on
    along it, search.distance far, then stops and holds (status CONTACT_MISSING). A
    contact in a segment that ends in none stops it as well (CONTACT_UNEXPECTED), unless
    search.go_on_unexpected. Where a contact is lost on the way it is pressed for; if
    there is nothing for 5 mm, its direction is held there (CONTACT_MISSING) until a
    contact is felt. While `contact` is NaN or has a status the motion pauses (HOLD,
    BAD_INPUT).

    Inputs:  contacts (ContactBelief); contact (14,); ee_pose (7,); optional motion
             (MotionPattern): another one that comes there is taken over, from where the
             motion is and at its speed, blended in over blend_sec or more.
    Outputs, all of them state: x_desired (19,) = [p, quaternion wxyz, v, w, a, alpha]
             of the tip in the world; direction (3,) unit vector of the motion, zero at
             rest; force_directions (6,), two rows, zero: none; force_targets (2,) [N];
             phase (6,), see numerics/contact_task.py.

    Args: pattern, begun at its first segment's time (the clock's, not the shaper's
        start); plan_sec, period in which `contacts` and `motion` are read; restarts: a
        pattern that comes on `motion` begins at its start, at rest and at once, without
        a blend, for motions that are handed over elsewhere.
    Raises: ValueError for a number that is not positive.
    Source: CC section 3.5.2, equation 11.
    """

    def __init__(
        self,
        config: VelocityShaperConfig,
        pattern: MotionPattern,
        plan_sec: float = 0.01,
        restarts: bool = False,
    ):
        super().__init__()
        check_settings(config)
        self._law = law = _law(config)
        if not 0.0 < plan_sec < np.inf:
            raise ValueError(f"plan_sec is {plan_sec}, expected > 0")
        self._pattern, self._anticipate = pattern, config.region.anticipate
        self._restarts = bool(restarts)
        self._no_regions, self._no_contact = np.zeros(N_REGIONS), np.zeros(N_CONTACT)
        first_call(warm_up, pattern, law)
        self._contacts = self.DeclareAbstractInputPort(
            "contacts", AbstractValue.Make(ContactBelief())
        )
        self._contact = self.DeclareVectorInputPort("contact", N_CONTACT)
        self._ee_pose = self.DeclareVectorInputPort("ee_pose", 7)
        self._motion = self.DeclareAbstractInputPort(
            "motion", AbstractValue.Make(pattern)
        )
        # Before the first update: at rest, before the pattern's first time.
        before = pattern.segments[0].times[0] - 1.0
        X, *rest = tick(
            pattern.table,
            law,
            np.zeros(N_REGIONS),
            np.zeros(N_MEMORY),
            before,
            np.zeros(N_CONTACT),
            np.zeros(7),
        )
        self._memory = self.DeclareDiscreteState(N_MEMORY)
        self._memory_old = self.DeclareDiscreteState(N_MEMORY)
        self._regions = self.DeclareDiscreteState(N_REGIONS)
        self._patterns = self.DeclareAbstractState(
            AbstractValue.Make(_Patterns(pattern, pattern))
        )
        self._outputs = []
        names = ("direction", "force_directions", "force_targets", "phase")
        values = [pose_output(X, pattern.base), *rest]
        for name, value in zip(("x_desired", *names), values, strict=True):
            state = self.DeclareDiscreteState(value)
            self.DeclareStateOutputPort(name, state)
            self._outputs.append(state)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            plan_sec, config.offset_sec, self._plan
        )
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    def _plan(self, context: Context, state):
        """Reads the belief and, if one is connected, the pattern."""
        t = context.get_time()
        discrete = state.get_mutable_discrete_state()
        memory = context.get_discrete_state(self._memory).value()
        patterns = self._now(context)
        if self._motion.HasValue(context):
            given = self._motion.Eval(context)
            # A blend that runs is finished first; the newest pattern is taken then.
            free = patterns.old is None or t >= patterns.t + patterns.T
            if given is not patterns.given and free:
                now = MotionPattern(
                    given.segments, given.acceleration_max, self._pattern.base
                )
                discrete.set_value(int(self._memory_old), memory)
                contact = self._contact.Eval(context)
                if self._restarts:
                    memory = begin_anew(now.table, contact, t)
                    patterns = _Patterns(now, given)
                else:
                    memory, T = take_over(
                        now.table, self._law, contact, t, patterns.now.table, memory
                    )
                    patterns = _Patterns(now, given, patterns.now, t, T)
                discrete.set_value(int(self._memory), memory)
                memory.setflags(write=False)  # As a state's, for compiled code.
                state.get_mutable_abstract_state(int(self._patterns)).set_value(
                    patterns
                )
        belief = self._contacts.Eval(context) if self._anticipate else ContactBelief()
        rows = expected(belief)
        regions = plan(patterns.now.table, self._law, memory, t, rows)
        discrete.set_value(int(self._regions), regions)

    def _now(self, context) -> _Patterns:
        return context.get_abstract_state(int(self._patterns)).get_value()

    @timed
    def _update(self, context: Context, discrete_state):
        t, law = context.get_time(), self._law
        contact, pose = self._contact.Eval(context), self._ee_pose.Eval(context)
        regions = discrete_state.value(self._regions)
        memory = discrete_state.get_mutable_value(self._memory)
        table, old = self._pattern.table, None
        if self._motion.HasValue(context):
            patterns = self._now(context)
            table, old = patterns.now.table, patterns.old
        X, *rest = tick(table, law, regions, memory, t, contact, pose)
        if old is not None and t < patterns.t + patterns.T:
            before = discrete_state.get_mutable_value(self._memory_old)
            X_old, *_ = tick(
                old.table, law, self._no_regions, before, t, self._no_contact, pose
            )
            X = blended(X_old, X, t - patterns.t, patterns.T)
        discrete_state.set_value(self._outputs[0], pose_output(X, self._pattern.base))
        for state, value in zip(self._outputs[1:], rest, strict=True):
            discrete_state.set_value(state, value)


def _law(config: VelocityShaperConfig) -> ShaperLaw:
    """Raises: ValueError for a number that makes no law, by name."""
    c, region, search = config, config.region, config.search
    for name, value, least in (
        ("acceleration_max", c.acceleration_max, 1e-6),
        ("speed_min", c.speed_min, 1e-6),
        ("release_sec", c.release_sec, 1e-6),
        ("region.sigmas", region.sigmas, 0.0),
        ("region.margin", region.margin, 0.0),
        ("region.settle_sec", region.settle_sec, 0.0),
        ("region.blend_sec", region.blend_sec, 1e-6),
        ("search.speed", search.speed, 1e-6),
        ("search.distance", search.distance, 0.0),
        ("period_sec", c.period_sec, 1e-6),
    ):
        endless = name == "release_sec" and value == np.inf
        if not (least <= value < np.inf or endless):
            wanted = "0 or more" if least == 0.0 else "a positive number"
            raise ValueError(f"{name} is {value}, expected {wanted}")
    return ShaperLaw(
        acceleration_max=float(c.acceleration_max),
        speed_min=float(c.speed_min),
        release_sec=float(c.release_sec),
        sigmas=float(region.sigmas),
        margin=float(region.margin),
        settle_sec=float(region.settle_sec),
        blend_sec=float(region.blend_sec),
        search_speed=float(search.speed),
        search_max=float(search.distance),
        go_on_unexpected=bool(search.go_on_unexpected),
        period=float(c.period_sec),
    )
