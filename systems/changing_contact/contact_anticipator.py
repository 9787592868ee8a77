"""The contact anticipator: see numerics/contact_anticipator.py for the model."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, LeafSystem

from makebreak.systems.changing_contact.numerics.contact_anticipator import (
    capped,
    contact_stiffness,
    impact_speed,
    is_expected,
    measurement_covariance,
    next_impact,
    place_at,
    predict,
    speed_by_error,
    speed_by_regression,
    spread_along,
    unbraked_force,
    update,
)
from makebreak.systems.changing_contact.numerics.contact_task import (
    BAD_INPUT,
    BROKEN,
    CHANGE_TIME,
    COUNT,
    DIRECTION,
    FOUND,
    FREE_MODE,
    FROM_MODE,
    IMPACT,
    IMPACTLESS,
    MADE,
    MEASURED,
    N_CONTACT,
    N_PHASE,
    N_TOUCH_MODE,
    N_TRANSITION,
    PEAK_FORCE,
    PHASE_SEGMENT,
    PHASE_SPEED,
    POSITION,
    SPEED,
    STATUS,
    TIME,
    TO_MODE,
    TOUCH_MODE,
    UNKNOWN_MODE,
    ContactBelief,
    ExpectedContact,
)
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed

HISTORY = 150  # Poses kept: 1.5 s at 100 Hz.
# A mode change so near in time to a contact, or to the beginning of a segment, belongs
# to it; it is no impact-less change.
SETTLE_SEC = 0.3
HINT_WAY = 0.02  # [m] past the place, and 3 sigma, for which the hint is given.
ANYWHERE = 1e3  # Standard deviation [m] along axes on which nothing is measured.
FORGET_STD = 0.02  # A learned contact that is not felt is given up at this sigma [m].


@dataclass
class ContactFilterConfig:
    """Standard deviations of the Kalman filter."""

    # Standard deviation of a felt contact's place along the motion [m].
    std_along: float = 0.0007
    # Standard deviation of a felt contact's place across the motion: how well the
    # motion repeats itself [m].
    std_across: float = 0.005
    # Standard deviation along the motion of the place of a change without impact [m].
    std_change: float = 0.002
    # Standard deviation of a contact's drift from one trial to the next [m].
    std_drift: float = 0.0003
    # Largest innovation along the motion for which what is felt is an expected contact
    # [standard deviations].
    gate: float = 3.0


@dataclass
class KnownReflexConfig:
    """The arm's impact reflex, on which the force of an impact depends. The diagram
    takes it from its setting `reflex`, where it has one."""

    gain: float = 0.0  # 0: no reflex.
    force_least: float = 0.0  # Least force of the reflex [N].
    # The same for contacts that were felt before [N]; 0: the same.
    force_known: float = 0.0


@dataclass
class FirstApproachConfig:
    """Of a contact that has not been felt."""

    speed: float = 0.05  # Approach speed v_a, if stiffness_most is 0 [m/s].
    # Stiffness of the stiffest contact that there may be [N/m]: the approach speed is
    # that at which it gives `force`, with the arm's effective mass; 0: `speed` is used.
    stiffness_most: float = 0.0
    force: float = 8.0  # Peak force of an impact on a contact of stiffness_most [N].
    # Whether the first stiffness that is felt is assumed of all other contacts.
    carry_over: bool = False


@dataclass
class ApproachSpeedConfig:
    """How fast a contact is approached, and how that is learned from impacts."""

    # Desired peak force F_d of an impact, along the motion [N].
    force_desired: float = 8.0
    first: FirstApproachConfig = field(default_factory=FirstApproachConfig)
    reflex: KnownReflexConfig = field(default_factory=KnownReflexConfig)
    # Whether the next approach speed follows from a regression F = s v over all
    # impacts; false: from eq. 9.
    regression: bool = True
    # Standard deviation, in proportion, by which the force of an impact at one speed
    # changes from one impact to the next: 0.01 for a surface that stays as it is, more
    # where the contact is never made at the same place.
    force_drift: float = 0.01
    beta: float = 0.002  # Gain beta of eq. 9, used without regression [m/s per N].
    # Largest factor of the approach speed from one trial to the next.
    growth: float = 1.4
    least: float = 0.001  # Smallest approach speed after a contact was felt [m/s].
    most: float = 0.2  # Largest approach speed [m/s].


@dataclass
class ContactAnticipatorConfig:
    """Settings of KalmanContactAnticipator."""

    filter: ContactFilterConfig = field(default_factory=ContactFilterConfig)
    speed: ApproachSpeedConfig = field(default_factory=ApproachSpeedConfig)
    # Time before its expected place at which a mode is announced [s].
    hint_lead_sec: float = 0.0
    period_sec: float = 0.01  # Period of the updates [s]; the diagram sets it.
    offset_sec: float = 0.0  # Time of the first update [s]; the diagram sets it.


@dataclass(frozen=True, eq=False)
class AnticipatorMemory:
    """All that the anticipator remembers, as a value: an update makes a new one."""

    belief: ContactBelief
    history: np.ndarray  # (n, 6): time, p_WE, segment, speed [m/s]; oldest first.
    made: float = 0.0  # Counters that were seen last.
    broken: float = 0.0
    measured: float = 0.0
    count: float = 0.0
    updated: tuple[int, ...] = ()  # Contacts felt in this trial,
    passed: tuple[int, ...] = ()  # and those that were passed without.
    last: int = -1  # The last contact made, while its force is awaited; -1: none.
    touch: int = -1  # The one whose mode is not identified yet; -1: none.
    found: float = 0.0  # Counts the touches whose mode was identified.
    last_time: float = -np.inf  # When one was made or broken [s].
    segment_time: float = 0.0  # When this segment began [s].
    status: int = 0
    trial: float = 0.0  # Of the port.

    def __copy__(self):
        return self

    def __deepcopy__(self, memo):
        return self  # Every part is immutable, so a Context may share it.


MAY_BE_ZERO = ("stiffness_most", *vars(KnownReflexConfig()))


def reduced_mass_one(p, d) -> float:
    """1 kg everywhere: as long as masses are about equal, only ratios count."""
    return 1.0


def first_speed(config: ApproachSpeedConfig, p, d, effective_mass) -> float:
    """v_a [m/s] of a contact that was never felt, at p (3,) along d (3,)."""
    first = config.first
    speed = first.speed
    if first.stiffness_most > 0.0:
        mass = effective_mass(p, d)
        force = unbraked_force(
            first.force, config.reflex.gain, config.reflex.force_least
        )
        speed = impact_speed(force, first.stiffness_most, mass)
    return float(min(speed, config.most))


class KalmanContactAnticipator(LeafSystem):
    """Expects contacts where they were felt, and approaches them at the right speed.

    Each expected contact is a Gaussian of the tip's position at the contact. When the
    contact detector reports one, the contact of this segment and direction whose gate
    it passes is updated, once a trial; if there is none, it is added. A change of mode
    without an impact, from `transition`, is an impact-less contact: its place is looked
    up in the recent past, at its change time, not where it was confirmed. A learned
    contact that is passed and not felt doubles its standard deviation; above FORGET_STD
    it is given up before the next trial. The mode that a contact brought, from
    `touch_mode`, is announced when that contact is felt in a later trial.

    The peak force of an impact gives the next approach speed: by regression of force on
    speed, or by eq. 9, at most `growth` times faster than before.

    Inputs:  ee_pose (7,) of the tip; contact (14,), transition (6,), phase (6,) of
             numerics/contact_task.py; optional touch_mode (2,), of the same;
             optional trial (1,): a motion that is repeated
             within one simulation counts its repetitions there. When the number
             changes a new trial begins: contacts drift by std_drift, and each can be
             felt once more.
    Outputs: contacts (abstract, ContactBelief);
             approach_speed (1,) of the next impact of this segment, 0 if none is
             expected [m/s];
             mode_hint (1,) the mode that begins at the expected place of an impact-less
             change, from hint_lead_sec before the tip passes it until HINT_WAY past its
             region; -1: none;
             impact_known (1,) 1 if this impact was felt before, else 0;
             touch_hint (1,) the mode that the last felt contact brought in an earlier
             trial, until its present mode is identified; -1: none;
             status (1,) 0, or BAD_INPUT: the belief is held.

    Source: CC 3.3, 3.4.1.
    """

    def __init__(
        self,
        config: ContactAnticipatorConfig,
        knowledge: ContactBelief | None = None,
        effective_mass: Callable[[np.ndarray, np.ndarray], float] = reduced_mass_one,
    ):
        """Args:
            knowledge: what is expected: a prior, or `knowledge` of the last trial. A
                contact without impacts is given the config's first speed; one that was
                felt drifts by std_drift.
            effective_mass: of the arm at a position (3,) along a direction (3,) [kg],
                for `carry_over` and `stiffness_most`.
        Raises: ValueError for numbers in config that are not positive.
        """
        super().__init__()
        check_settings(config)
        self._filter, self._speed = replace(config.filter), replace(config.speed)
        speed = dict(vars(config.speed))
        parts = (config.filter, speed.pop("reflex"), speed.pop("first"))
        numbers = {k: v for part in parts for k, v in vars(part).items()} | speed
        for name, value in numbers.items():
            if isinstance(value, bool):
                continue
            if value == 0.0 and name in MAY_BE_ZERO:
                continue
            if not 0.0 < value < np.inf:
                raise ValueError(f"{name} is {value}, expected a positive number")
        if self._speed.least > self._speed.most:
            raise ValueError(
                f"least is {self._speed.least}, expected at most `most`, "
                f"{self._speed.most}"
            )
        if self._speed.growth < 1.0:
            raise ValueError(f"growth is {self._speed.growth}, expected 1 or more")
        if not 0.0 <= config.hint_lead_sec < np.inf:
            raise ValueError(
                f"hint_lead_sec is {config.hint_lead_sec}, expected 0 or more"
            )
        self._lead = float(config.hint_lead_sec)
        self._period = float(config.period_sec)
        self._mass = effective_mass
        belief = self._next_trial(ContactBelief() if knowledge is None else knowledge)
        memory = AnticipatorMemory(belief, np.zeros((0, 6)))
        self._pose = self.DeclareVectorInputPort("ee_pose", 7)
        self._contact = self.DeclareVectorInputPort("contact", N_CONTACT)
        self._transition = self.DeclareVectorInputPort("transition", N_TRANSITION)
        self._phase = self.DeclareVectorInputPort("phase", N_PHASE)
        self._touch_mode = self.DeclareVectorInputPort("touch_mode", N_TOUCH_MODE)
        self._trial = self.DeclareVectorInputPort("trial", 1)
        self._memory = self.DeclareAbstractState(Value(memory))
        ticket = {self.abstract_state_ticket(self._memory)}
        self.DeclareAbstractOutputPort(
            "contacts",
            lambda: Value(ContactBelief()),
            lambda context, output: output.set_value(self.knowledge(context)),
            ticket,
        )
        for name, calc in (
            ("approach_speed", self._approach_speed),
            ("impact_known", _impact_known),
            ("touch_hint", _touch_hint),
            ("status", lambda memory: float(memory.status)),
        ):
            self.DeclareVectorOutputPort(name, 1, partial(self._put, calc), ticket)
        # Computed when read, between two updates too: it depends on time.
        self.DeclareVectorOutputPort(
            "mode_hint", 1, self._put_hint, ticket | {self.time_ticket()}
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    def knowledge(self, context: Context) -> ContactBelief:
        """What is believed now: for the next trial's constructor, or to be saved."""
        return self._memory_of(context).belief

    def _memory_of(self, context) -> AnticipatorMemory:
        return context.get_abstract_state(self._memory).get_value()

    def _put(self, calc, context, output):
        output.SetFromVector([calc(self._memory_of(context))])

    def _approach_speed(self, memory) -> float:
        contact = _next_impact(memory)
        return 0.0 if contact is None else contact.approach_speed

    def _put_hint(self, context, output):
        memory = self._memory_of(context)
        output.SetFromVector([self._mode_hint(memory, context.get_time())])

    def _mode_hint(self, memory, time) -> float:
        if len(memory.history) == 0:
            return -1.0
        p, segment = memory.history[-1, 1:4], int(memory.history[-1, 4])
        best, least = -1.0, np.inf
        if len(memory.history) > 5:
            before, now = memory.history[-6], memory.history[-1]
            ahead = self._lead + min(time - now[0], self._period)
            p = p + ahead * (now[1:4] - before[1:4]) / (now[0] - before[0])
        for contact in memory.belief.contacts:
            if contact.kind != IMPACTLESS or contact.segment != segment:
                continue
            past = (p - contact.mean) @ contact.direction
            sigma = spread_along(contact.covariance, contact.direction)
            if 0.0 <= past < min(least, 3.0 * sigma + HINT_WAY):
                best, least = float(contact.to_mode), past
        return best

    def _next_trial(self, belief: ContactBelief) -> ContactBelief:
        """The belief at the beginning of a trial: learned contacts have drifted,
        uncertain ones are dropped, those never felt get the first speed."""
        drift = self._filter.std_drift**2 * np.eye(3)
        contacts = []
        for contact in belief.contacts:
            if contact.seen > 0:
                # Within a trial none is dropped: others know it by its index.
                if spread_along(contact.covariance, contact.direction) > FORGET_STD:
                    continue
                mean, covariance = predict(contact.mean, contact.covariance, drift)
                contact = replace(contact, mean=mean, covariance=covariance)
            if len(contact.impacts) == 0:
                speed = self._first_speed(contact.mean, contact.direction)
                contact = replace(contact, approach_speed=speed)
            contacts.append(contact)
        return ContactBelief(tuple(contacts))

    def _begun(self, memory, context) -> AnticipatorMemory:
        """The memory; that of a new trial if the number on the port `trial` changed."""
        if not self._trial.HasValue(context):
            return memory
        trial = float(self._trial.Eval(context)[0])
        if trial == memory.trial or not np.isfinite(trial):
            return memory
        belief = self._next_trial(memory.belief)
        return replace(
            memory, belief=belief, trial=trial, updated=(), passed=(), last=-1, touch=-1
        )

    @timed
    def _update(self, context: Context, state):
        memory = self._after(
            self._begun(self._memory_of(context), context),
            context.get_time(),
            *[
                port.Eval(context)
                for port in (self._pose, self._contact, self._transition, self._phase)
            ],
        )
        if self._touch_mode.HasValue(context):
            memory = _found(memory, self._touch_mode.Eval(context))
        state.get_mutable_abstract_state(self._memory).set_value(memory)

    def _after(self, memory, time, pose, contact, transition, phase):
        """The memory after one update."""
        inputs = (pose[:3], contact, transition, phase)
        if not all(np.all(np.isfinite(x)) for x in inputs):
            return replace(memory, status=BAD_INPUT)
        status = BAD_INPUT if contact[STATUS] else 0
        segment = phase[PHASE_SEGMENT]
        row = np.array([[time, *pose[:3], segment, phase[PHASE_SPEED]]])
        history = np.vstack([memory.history[-(HISTORY - 1) :], row])
        history.setflags(write=False)
        began = len(memory.history) == 0 or memory.history[-1, 4] != segment
        memory = replace(
            memory,
            history=history,
            status=status,
            segment_time=time if began else memory.segment_time,
        )
        if contact[BROKEN] > memory.broken:
            memory = replace(memory, broken=contact[BROKEN], last_time=time)
        if contact[MADE] > memory.made:
            memory = self._felt(memory, contact)
        if contact[MEASURED] > memory.measured:
            memory = self._measured(memory, contact)
        if transition[COUNT] > memory.count:
            memory = self._changed(memory, transition)
        return self._without_passed(memory)

    # An impact.

    def _felt(self, memory, contact):
        """The memory after a contact was made: the expected contact it belongs to is
        corrected, or a new one is added."""
        p, d, time = contact[POSITION], contact[DIRECTION], contact[TIME]
        memory = replace(memory, made=contact[MADE], last=-1, last_time=time)
        if not abs(np.linalg.norm(d) - 1.0) < 1e-3:
            return replace(memory, status=BAD_INPUT)
        d = d / np.linalg.norm(d)
        segment = _segment_at(memory.history, time)
        c = self._filter
        for k in memory.updated:
            if _is_same(memory.belief.contacts[k], p, d):
                # A bounce: felt in this trial, here, before.
                return replace(memory, touch=k)
        R = measurement_covariance(d, c.std_along, c.std_across)
        k = self._matching(memory.belief, IMPACT, segment, p, d, c.std_along)
        if k is not None and k in memory.updated:
            return replace(memory, touch=k)  # Two detections of one contact.
        if k is None:
            added = ExpectedContact(
                mean=p,
                covariance=R,
                direction=d,
                kind=IMPACT,
                segment=segment,
                approach_speed=self._first_speed(p, d),
                seen=1,
            )
            belief = ContactBelief((*memory.belief.contacts, added))
            k = len(belief.contacts) - 1
        else:
            belief = self._corrected(memory.belief, k, p, R)
            belief = self._informed(belief, k, p)
        updated = (*memory.updated, k)
        return replace(memory, belief=belief, last=k, touch=k, updated=updated)

    def _informed(self, belief, k, p):
        """The belief after contact k was felt at p (3,): contacts whose positions
        follow from its position are where it says, until they are felt themselves."""
        source = belief.contacts[k]
        for i, contact in enumerate(belief.contacts):
            if not contact.known_from or contact.seen > 0:
                continue
            segment, distance, std = contact.known_from
            d = contact.direction
            if segment != source.segment or d @ source.direction < 0.99:
                continue
            there = contact.mean + d * ((p - contact.mean) @ d + distance)
            R = measurement_covariance(
                d, np.hypot(self._filter.std_along, std), ANYWHERE
            )
            mean, covariance = update(contact.mean, contact.covariance, there, R)
            belief = belief.changed(i, mean=mean, covariance=covariance)
        return belief

    def _matching(self, belief, kind, segment, p, d, std_along) -> int | None:
        """Index of the expected contact that was felt: the nearest along d."""
        found, nearest = None, np.inf
        for k, contact in enumerate(belief.contacts):
            away = abs((contact.mean - p) @ d)
            if (
                contact.kind == kind
                and contact.segment == segment
                and away < nearest
                and is_expected(contact, p, d, std_along, self._filter.gate)
            ):
                found, nearest = k, away
        return found

    def _corrected(self, belief, k, p, R, **changes):
        contact = belief.contacts[k]
        mean, covariance = update(contact.mean, contact.covariance, p, R)
        return belief.changed(
            k, mean=mean, covariance=covariance, seen=contact.seen + 1, **changes
        )

    def _measured(self, memory, contact):
        """The memory after the last contact's peak force is known: its next speed."""
        memory = replace(memory, measured=contact[MEASURED])
        # Where the motion's own speed is known it is the one that can be chosen next: a
        # tip that lags behind will lag again, and it has no noise.
        planned = _before(memory.history, contact[TIME])[5]
        speed = planned if planned > 0.0 else contact[SPEED]
        force = contact[PEAK_FORCE]
        k = memory.last
        if k < 0 or not (speed > 0.0 and force > 0.0):
            return memory
        known = memory.belief.contacts[k]
        impacts = np.vstack([known.impacts, [speed, force]])[-20:]
        belief = memory.belief.changed(
            k, impacts=impacts, approach_speed=self._next_speed(known, impacts)
        )
        if self._speed.first.carry_over:
            belief = self._carried_over(belief, k)
        return replace(memory, belief=belief, last=-1)

    def _first_speed(self, p, d) -> float:
        return first_speed(self._speed, p, d, self._mass)

    def _next_speed(self, contact, impacts) -> float:
        s = self._speed
        before = contact.approach_speed
        if s.regression:
            speed = speed_by_regression(
                impacts,
                s.force_desired,
                s.reflex.gain,
                s.reflex.force_least,
                s.reflex.force_known or None,
                s.force_drift,
            )
        else:
            speed = speed_by_error(before, s.force_desired, impacts[-1, 1], s.beta)
        return capped(speed, before, s.growth, s.least, s.most)

    def _carried_over(self, belief, k):
        """The belief with the stiffness of contact k assumed of contacts never felt."""
        s, source = self._speed, belief.contacts[k]
        speed, force = source.impacts[-1]
        mass = self._mass(source.mean, source.direction)
        reflex, least = s.reflex, s.reflex.force_least
        known = (reflex.force_known or least) if len(source.impacts) > 1 else least
        force = unbraked_force(force, reflex.gain, known)
        stiffness = contact_stiffness(speed, force, mass)
        wanted = unbraked_force(s.force_desired, reflex.gain, least)
        for i, contact in enumerate(belief.contacts):
            if contact.kind != IMPACT or len(contact.impacts):
                continue
            mass = self._mass(contact.mean, contact.direction)
            new = impact_speed(wanted, stiffness, mass)
            first = self._first_speed(contact.mean, contact.direction)
            new = capped(new, first, s.growth, s.least, s.most)
            belief = belief.changed(i, approach_speed=new)
        return belief

    # A change without impact.

    def _changed(self, memory, transition):
        """The memory after a change of mode: an impact-less contact is corrected or
        added, unless the change belongs to a contact or a segment's beginning."""
        memory = replace(memory, count=transition[COUNT])
        time = transition[CHANGE_TIME]
        modes = int(transition[FROM_MODE]), int(transition[TO_MODE])
        if min(modes) <= FREE_MODE or modes[0] == modes[1]:
            return memory
        near_contact = abs(time - memory.last_time) < SETTLE_SEC
        if near_contact or time - memory.segment_time < SETTLE_SEC:
            return memory
        found = place_at(memory.history[:, 0], memory.history[:, 1:4], time)
        if found is None:
            return memory
        p, d = found
        segment = _segment_at(memory.history, time)
        c = self._filter
        R = measurement_covariance(d, c.std_change, c.std_across)
        k = self._matching(memory.belief, IMPACTLESS, segment, p, d, c.std_change)
        if k is not None and k in memory.updated:
            return memory
        if k is None:
            added = ExpectedContact(
                mean=p,
                covariance=R,
                direction=d,
                kind=IMPACTLESS,
                segment=segment,
                seen=1,
                from_mode=modes[0],
                to_mode=modes[1],
            )
            belief = ContactBelief((*memory.belief.contacts, added))
            k = len(belief.contacts) - 1
        else:
            belief = self._corrected(
                memory.belief, k, p, R, from_mode=modes[0], to_mode=modes[1]
            )
        return replace(memory, belief=belief, updated=(*memory.updated, k))

    def _without_passed(self, memory):
        """The memory with double the standard deviation for each learned contact that
        the tip has passed without feeling it."""
        p, segment = memory.history[-1, 1:4], int(memory.history[-1, 4])
        for k, contact in enumerate(memory.belief.contacts):
            if contact.segment != segment or contact.seen == 0:
                continue
            if k in memory.updated or k in memory.passed:
                continue
            sigma = spread_along(contact.covariance, contact.direction)
            # An impact-less change is confirmed only a while after its place.
            margin = 0.005 if contact.kind == IMPACT else 0.05
            past = (p - contact.mean) @ contact.direction
            if past < self._filter.gate * sigma + margin:
                continue
            # A way that begins beyond it has not passed it.
            here = memory.history[memory.history[:, 0] >= memory.segment_time]
            if not np.any((here[:, 1:4] - contact.mean) @ contact.direction < 0.0):
                continue
            memory = replace(memory, passed=(*memory.passed, k))
            belief = memory.belief.changed(k, covariance=4.0 * contact.covariance)
            memory = replace(memory, belief=belief)
        return memory


def _next_impact(memory: AnticipatorMemory) -> ExpectedContact | None:
    """The next impact that is expected in this segment."""
    if len(memory.history) == 0:
        return None
    p, segment = memory.history[-1, 1:4], int(memory.history[-1, 4])
    k = next_impact(memory.belief.contacts, IMPACT, segment, p)
    return None if k is None else memory.belief.contacts[k]


def _impact_known(memory: AnticipatorMemory) -> float:
    """Whether the force of the next impact was measured before."""
    contact = _next_impact(memory)
    return float(contact is not None and len(contact.impacts) > 0)


def _touch_hint(memory: AnticipatorMemory) -> float:
    """The mode that the last felt contact brought in an earlier trial."""
    if memory.touch < 0:
        return float(UNKNOWN_MODE)
    return float(memory.belief.contacts[memory.touch].to_mode)


def _found(memory: AnticipatorMemory, touch_mode) -> AnticipatorMemory:
    """The memory after the mode of a touch was identified."""
    if not touch_mode[FOUND] > memory.found:
        return memory
    belief = memory.belief
    if memory.touch >= 0:
        belief = belief.changed(memory.touch, to_mode=int(touch_mode[TOUCH_MODE]))
    return replace(memory, belief=belief, touch=-1, found=touch_mode[FOUND])


def _before(history, time) -> np.ndarray:
    """The row of the history just before `time`."""
    before = history[history[:, 0] < time]
    return before[-1] if len(before) else history[0]


def _segment_at(history, time) -> int:
    """The number of the segment that the tip was in just before `time`."""
    return int(_before(history, time)[4])


def _is_same(contact: ExpectedContact, p, d) -> bool:
    """Whether p, on the way along d, is where this impact was just felt."""
    return (
        contact.kind == IMPACT
        and bool(contact.direction @ d > 0.7)
        and bool(np.linalg.norm(p - contact.mean) < 0.005)
    )
