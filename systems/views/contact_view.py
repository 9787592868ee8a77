"""Meshcat's view of a motion that makes and breaks contact."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Box, Meshcat, MeshcatCone, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import LeafSystem

from makebreak.systems.changing_contact.numerics.contact_anticipator import semi_axes
from makebreak.systems.changing_contact.numerics.contact_task import (
    IMPACT,
    IMPACTLESS,
    N_PHASE,
    PHASE_SPEED,
    UNKNOWN_MODE,
    ContactBelief,
)
from makebreak.systems.views.numerics.trail import Trail

_ROOT = "/makebreak/contact"
_NOWHERE = RigidTransform([0.0, 0.0, -5.0])
_BESIDE = np.array([0.045, -0.045, 0.06])  # From the tip to the ball of the mode [m].
_REGIONS = 6  # Largest number of regions of each kind that are drawn.
_KIND_COLORS = {IMPACT: Rgba(0.9, 0.2, 0.2, 0.3), IMPACTLESS: Rgba(0.2, 0.4, 0.95, 0.3)}
_PLAN = Rgba(0.65, 0.25, 0.75)
_TARGET, _TRACK, _FORCE = Rgba(0.1, 0.1, 0.2), Rgba(1.0, 0.5, 0.0), Rgba(0.1, 0.1, 0.1)
_GOOD, _BAD = Rgba(0.3, 0.7, 0.3), Rgba(0.85, 0.25, 0.2)  # Bars.
# Unknown, free, then the contact modes in their order; further ones repeat from the
# third colour on.
_MODE_COLORS = (
    Rgba(1.0, 1.0, 1.0),
    Rgba(0.6, 0.6, 0.6),
    Rgba(0.1, 0.6, 0.9),
    Rgba(0.95, 0.6, 0.1),
    Rgba(0.3, 0.75, 0.3),
    Rgba(0.75, 0.3, 0.8),
    Rgba(0.9, 0.85, 0.1),
)
FORCE_SLIDER, SPEED_SLIDER = "force [N]", "speed [mm/s]"  # Longer ones are cut off.


@dataclass
class ContactViewConfig:
    """Settings of ContactView."""

    sigmas: float = 2.0  # Half axes of the regions, in standard deviations.
    force_scale: float = 0.012  # Length of the arrow [m/N].
    # Peak forces of earlier trials, one list per trial [N]: a group of bars each.
    peaks: list[list[float]] = field(default_factory=list)
    peak_limit: float = 8.5  # Bars above it are red [N].
    bars_at: list[float] = field(default_factory=lambda: [0.25, -0.42])  # [m]
    camera: list[float] = field(default_factory=lambda: [1.1, -0.72, 0.6])  # [m]
    period_sec: float = 1.0 / 15.0


class ContactView(LeafSystem):
    """Draws the regions in which contacts are expected (ellipsoids: red for an impact,
    blue for a change without one), the contact force (an arrow from the tool), the mode
    (colour of the ball beside the tool), the target path (dark), the tip's track
    (orange), and the peak forces of earlier trials (bars). The planned path (purple) is
    drawn before the simulation begins; contacts shift the target path away from it.

    Inputs: contacts (ContactBelief); wrench (6,): on the tool [N], [N m]; ee_pose (7,);
            mode (1,); phase (6,); x_desired (19,), optional: for the target path.

    Args: plan: positions (n, 3) of each piece of the planned path [m].
    """

    LOOK_AT = (0.42, 0.0, 0.14)  # [m]
    LEGEND = (
        ("an impact is expected", _KIND_COLORS[IMPACT]),
        ("a change of contact is expected", _KIND_COLORS[IMPACTLESS]),
        ("contact force", _FORCE),
        ("planned path, before contacts shift it", _PLAN),
        ("target path", _TARGET),
        ("track of the tool", _TRACK),
        ("ball beside the tool: no contact", _MODE_COLORS[1]),
        ("ball beside the tool: first contact mode", _MODE_COLORS[2]),
    )

    def __init__(
        self,
        config: ContactViewConfig,
        meshcat: Meshcat,
        offset_sec: float = 0.0,
        plan: Sequence[np.ndarray] = (),
    ):
        super().__init__()
        self._config, self._meshcat = config, meshcat
        self._contacts = self.DeclareAbstractInputPort(
            "contacts", AbstractValue.Make(ContactBelief())
        )
        self._wrench = self.DeclareVectorInputPort("wrench", 6)
        self._ee_pose = self.DeclareVectorInputPort("ee_pose", 7)
        self._mode = self.DeclareVectorInputPort("mode", 1)
        self._phase = self.DeclareVectorInputPort("phase", N_PHASE)
        self._x_desired = self.DeclareVectorInputPort("x_desired", 19)
        # Points of the target path and of the track.
        self._path = self.DeclareAbstractState(AbstractValue.Make(np.zeros((0, 6))))
        meshcat.Delete(_ROOT)
        self.camera, self.legend = config.camera, list(self.LEGEND)
        if config.peaks:
            limit = f"{config.peak_limit:g} N"
            self.legend += [
                (f"bars: peak forces so far, up to {limit}", _GOOD),
                (f"bars: above {limit}", _BAD),
            ]
        meshcat.SetCameraPose(config.camera, self.LOOK_AT)
        for k, piece in enumerate(plan):
            meshcat.SetLine(f"{_ROOT}/plan/{k}", np.asarray(piece).T, 3.0, _PLAN)
        self._target = Trail(meshcat, f"{_ROOT}/target", _TARGET, 2.0)
        self._track = Trail(meshcat, f"{_ROOT}/track", _TRACK)
        for kind, color in _KIND_COLORS.items():
            for i in range(_REGIONS):
                self._draw(_region(kind, i), Sphere(1.0), color)
        for i, color in enumerate(_MODE_COLORS):
            self._draw(f"{_ROOT}/mode/{i}", Sphere(0.014), color)
        self._draw(f"{_ROOT}/force/shaft", Box(0.006, 0.006, 1.0), _FORCE)
        self._draw(f"{_ROOT}/force/head", MeshcatCone(0.025, 0.01, 0.01), _FORCE)
        self._draw_bars()
        for name, most in ((FORCE_SLIDER, 60.0), (SPEED_SLIDER, 300.0)):
            meshcat.DeleteSlider(name, strict=False)
            meshcat.AddSlider(name, 0.0, most, 0.1, 0.0)
        self.DeclarePeriodicPublishEvent(config.period_sec, offset_sec, self._publish)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            config.period_sec, offset_sec, self._remember
        )

    def _draw(self, path, shape, color):
        self._meshcat.SetObject(path, shape, color)
        self._meshcat.SetTransform(path, _NOWHERE)

    def _draw_bars(self):
        c = self._config
        x, y = c.bars_at
        for i, trial in enumerate(c.peaks):
            for j, peak in enumerate(trial):
                if not np.isfinite(peak):
                    continue
                height = max(0.004 * min(peak, 50.0), 0.001)  # 4 mm per newton.
                path = f"{_ROOT}/peaks/{i}/{j}"
                good = peak <= c.peak_limit
                color = _GOOD if good else _BAD
                self._meshcat.SetObject(path, Box(0.012, 0.012, height), color)
                place = [x + 0.016 * j, y - 0.03 * i, height / 2]
                self._meshcat.SetTransform(path, RigidTransform(place))

    def _remember(self, context, state):
        path = context.get_abstract_state(int(self._path)).get_value()
        p = self._ee_pose.Eval(context)[:3]
        target = p
        if self._x_desired.HasValue(context):
            target = self._x_desired.Eval(context)[:3]
        point = np.concatenate([target, p])[None]
        if np.all(np.isfinite(point)):
            path = np.concatenate([path, point])
            state.get_mutable_abstract_state(int(self._path)).set_value(path)

    def _publish(self, context):
        t, meshcat = context.get_time(), self._meshcat
        pose = self._ee_pose.Eval(context)
        if not np.all(np.isfinite(pose)):
            return
        p = pose[:3]
        self._show_regions(self._contacts.Eval(context), t)
        mode = self._mode.Eval(context)[0]
        mode = int(mode) if np.isfinite(mode) else UNKNOWN_MODE
        shown = mode + 1 if mode < 1 else 2 + (mode - 1) % (len(_MODE_COLORS) - 2)
        for i in range(len(_MODE_COLORS)):
            X = RigidTransform(p + _BESIDE) if i == shown else _NOWHERE
            meshcat.SetTransform(f"{_ROOT}/mode/{i}", X, t)
        force = self._wrench.Eval(context)[:3]
        if not np.all(np.isfinite(force)):
            force = np.zeros(3)
        self._show_force(p, force, t)
        meshcat.SetSliderValue(FORCE_SLIDER, float(np.linalg.norm(force)))
        speed = self._phase.Eval(context)[PHASE_SPEED]
        if np.isfinite(speed):
            meshcat.SetSliderValue(SPEED_SLIDER, 1e3 * float(speed))
        path = context.get_abstract_state(int(self._path)).get_value()
        self._target.show(path[:, :3], t)
        self._track.show(path[:, 3:], t)

    def _show_regions(self, belief, t):
        for kind in _KIND_COLORS:
            contacts = [c for c in belief.contacts if c.kind == kind][:_REGIONS]
            for i in range(_REGIONS):
                path = _region(kind, i)
                if i >= len(contacts):
                    self._meshcat.SetTransform(path, _NOWHERE, t)
                    continue
                half, axes = semi_axes(contacts[i].covariance, self._config.sigmas)
                # At least a millimetre, so that small regions remain visible.
                half = np.maximum(half, 0.001)
                X = RigidTransform(RotationMatrix(axes), contacts[i].mean)
                self._meshcat.SetTransform(path, X, t)
                self._meshcat.SetProperty(f"{path}/<object>", "scale", list(half), t)

    def _show_force(self, p, force, t):
        size = float(np.linalg.norm(force))
        shaft, head = f"{_ROOT}/force/shaft", f"{_ROOT}/force/head"
        if size < 0.5:
            self._meshcat.SetTransform(shaft, _NOWHERE, t)
            self._meshcat.SetTransform(head, _NOWHERE, t)
            return
        along = RotationMatrix.MakeFromOneVector(force / size, 2)
        length = self._config.force_scale * size
        middle, end = (p + share * length * force / size for share in (0.5, 1.0))
        self._meshcat.SetTransform(shaft, RigidTransform(along, middle), t)
        self._meshcat.SetProperty(f"{shaft}/<object>", "scale", [1.0, 1.0, length], t)
        # The cone's point is its origin, and it widens along z.
        back = along @ RotationMatrix.MakeXRotation(np.pi)
        tip = end + 0.025 * force / size
        self._meshcat.SetTransform(head, RigidTransform(back, tip), t)


def _region(kind, i):
    return f"{_ROOT}/region/{kind}/{i}"
