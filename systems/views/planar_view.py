"""Meshcat's view of a point effector in the plane."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.geometry import Box, Cylinder, Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import LeafSystem

_HEIGHT = 0.02  # Of moving objects above the floor [m].
_TRACE_DOTS = 120
_ROOT = "/makebreak/planar"

_EFFECTOR, _TARGET = Rgba(0.13, 0.4, 0.9), Rgba(0.95, 0.55, 0.1)
_SPRING = Rgba(0.4, 0.4, 0.4)


@dataclass
class PlanarViewConfig:
    """Settings of PlanarView."""

    anchors: list[list[float]] = field(default_factory=list)  # Of the springs [m].
    stiffness: list[float] = field(default_factory=list)  # One per anchor [N/m].
    # Initial and final viscosity [N s/m], shown as a bar that grows over ramp_sec.
    viscosity: list[float] = field(default_factory=lambda: [0.0, 0.0])
    ramp_sec: float = 6.0
    period_sec: float = 1.0 / 30.0


class PlanarView(LeafSystem):
    """Shows effector (blue), target (orange) and springs, and the path of both.

    A spring's thickness grows with its stiffness. The paths are rows of dots, drawn
    over ramp_sec. In porridge the length of a bar beside the circle shows the
    viscosity, 0.5 m at 200 N s/m.

    Inputs: state (4,) p, v; x_desired (6,) p, v, a.
    """

    CAMERA, LOOK_AT = (0.0, -0.3, 1.25), (0.0, 0.0, 0.0)  # [m]
    LEGEND = (
        ("effector, and its path", _EFFECTOR),
        ("target, and its path", _TARGET),
        ("springs: the thicker, the stiffer", _SPRING),
    )

    def __init__(
        self, config: PlanarViewConfig, meshcat: Meshcat, offset_sec: float = 0.0
    ):
        super().__init__()
        c = config
        self._meshcat = meshcat
        self._anchors = np.array(c.anchors, dtype=float).reshape(-1, 2)
        self._viscosity, self._ramp = c.viscosity, c.ramp_sec
        self._state = self.DeclareVectorInputPort("state", 4)
        self._target = self.DeclareVectorInputPort("x_desired", 6)
        meshcat.SetCameraPose(self.CAMERA, self.LOOK_AT)
        floor = Rgba(0.96, 0.94, 0.88)
        meshcat.SetObject(f"{_ROOT}/floor", Box(2.4, 2.4, 0.002), floor)
        if c.viscosity[0] != c.viscosity[1]:
            brown = Rgba(0.6, 0.42, 0.22)
            meshcat.SetObject(f"{_ROOT}/viscosity", Box(0.03, 1.0, 0.01), brown)
            self._show_viscosity(0.0)
        meshcat.SetObject(f"{_ROOT}/effector", Sphere(0.02), _EFFECTOR)
        meshcat.SetObject(f"{_ROOT}/target", Sphere(0.012), _TARGET)
        for i in range(_TRACE_DOTS):
            meshcat.SetObject(self._dot(i), Sphere(0.005), _EFFECTOR)
            meshcat.SetTransform(self._dot(i), RigidTransform([0.0, 0.0, -0.1]))
            meshcat.SetObject(f"{_ROOT}/goal/{i}", Sphere(0.003), _TARGET)
            meshcat.SetTransform(f"{_ROOT}/goal/{i}", RigidTransform([0.0, 0.0, -0.1]))
        for i, (anchor, k) in enumerate(zip(self._anchors, c.stiffness, strict=True)):
            radius = 0.002 + 0.006 * k / max(c.stiffness)
            name = self._spring(i)
            meshcat.SetObject(f"{name}/coil", Cylinder(radius, 1.0), _SPRING)
            meshcat.SetObject(f"{name}_anchor", Sphere(0.02), Rgba(0.2, 0.2, 0.2))
            meshcat.SetTransform(f"{name}_anchor", RigidTransform([*anchor, _HEIGHT]))
        self.DeclarePeriodicPublishEvent(c.period_sec, offset_sec, self._publish)

    def _dot(self, i):
        return f"{_ROOT}/trace/{i}"

    def _spring(self, i):
        return f"{_ROOT}/spring_{i}"

    def _show_viscosity(self, t):
        first, last = self._viscosity
        c = first + (last - first) * min(t / self._ramp, 1.0)
        length, bar = 0.001 + 0.5 * c / 200.0, f"{_ROOT}/viscosity"
        place = RigidTransform([0.4, -0.25 + 0.5 * length, _HEIGHT])
        self._meshcat.SetTransform(bar, place, t)
        # Scale the object, not its path: a transform resets the scale of its path.
        self._meshcat.SetProperty(f"{bar}/<object>", "scale", [1.0, length, 1.0], t)

    def _publish(self, context):
        t = context.get_time()
        p = np.array([*self._state.Eval(context)[:2], _HEIGHT])
        goal = np.array([*self._target.Eval(context)[:2], _HEIGHT])
        meshcat = self._meshcat
        meshcat.SetTransform(f"{_ROOT}/effector", RigidTransform(p), t)
        meshcat.SetTransform(f"{_ROOT}/target", RigidTransform(goal), t)
        dot = int(t / self._ramp * _TRACE_DOTS)
        if dot < _TRACE_DOTS:
            meshcat.SetTransform(self._dot(dot), RigidTransform(p), t)
            meshcat.SetTransform(f"{_ROOT}/goal/{dot}", RigidTransform(goal), t)
        for i, anchor in enumerate(self._anchors):
            a = np.array([*anchor, _HEIGHT])
            length = max(float(np.linalg.norm(p - a)), 1e-6)
            R = RotationMatrix.MakeFromOneVector((p - a) / length, 2)
            X = RigidTransform(R, 0.5 * (p + a))
            meshcat.SetTransform(self._spring(i), X, t)
            coil = f"{self._spring(i)}/coil"
            meshcat.SetProperty(coil, "scale", [1.0, 1.0, length], t)
        if self._viscosity[0] != self._viscosity[1]:
            self._show_viscosity(t)
