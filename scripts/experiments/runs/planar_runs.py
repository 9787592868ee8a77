"""Common parts of the planar experiments: trials, scores and plots."""

import numpy as np
from matplotlib.axes import Axes
from pydrake.systems.framework import Diagram

from makebreak.diagrams.planar import PLANAR, PlanarSensing
from makebreak.diagrams.recorder import recorded, with_noise
from makebreak.models.scene import read_scene
from makebreak.scripts.runner.session import Log, Session

DURATION, SAMPLE = 6.0, 0.005  # [s]
_PORTS = (
    "state x_desired u force force_measured status "
    "stiffness force_predicted prediction_error trust"
).split()
AT_LIMIT = 2  # Bit of every planar controller's status.


def trial(session: Session, diagram: Diagram, label: str) -> Log:
    """Simulates one trial of a diagram of make_planar, and logs its output ports."""
    names = [name for name in _PORTS if diagram.HasOutputPort(name)]
    return session.simulate(
        diagram,
        DURATION,
        {name: diagram.GetOutputPort(name) for name in names},
        period_sec=SAMPLE,
        label=label,
    )


def errors(log: Log) -> np.ndarray:
    """Distance from the target at each sample (n,) [m]."""
    return np.linalg.norm(log["state"][:, :2] - log["x_desired"][:, :2], axis=1)


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def error_rms(log: Log) -> float:
    """[m]"""
    return rms(errors(log))


def limit_share(log: Log) -> float:
    """The fraction of samples with the controller's force at its limit."""
    return float(np.mean((log["status"][:, 0].astype(int) & AT_LIMIT) > 0))


def along_motion(log: Log, column: str) -> np.ndarray:
    """The component of the force in `column` against the effector's motion (n,) [N]; 0
    at rest."""
    v = log["state"][:, 2:]
    speed = np.linalg.norm(v, axis=1, keepdims=True)
    direction = np.divide(v, speed, out=np.zeros_like(v), where=speed > 1e-3)
    return -np.sum(log[column] * direction, axis=1)


def plot_path(ax: Axes, log: Log, label: str, target: bool = True, **style):
    """Plots the effector's path within the axes' limits."""
    if target:
        ax.plot(*log["x_desired"][:, :2].T, ":", color="0.3", label="target")
    ax.plot(*log["state"][:, :2].T, label=label, **style)
    ax.set(xlim=(-0.55, 0.55), ylim=(-0.55, 0.55), aspect=1, xlabel="x [m]")


def write_recording(session: Session, log: Log, sensing: PlanarSensing, seed: int):
    """Writes the measurements of a trial, with the effector alone as the model."""
    columns = recorded(log.diagram, log.context)
    if not any(sensing.state_std()):
        columns = with_noise(columns, seed)
    session.write_recording(columns, read_scene(PLANAR))


def median_range(values, scale: float = 1.0, unit: str = "") -> str:
    """ "median (min to max)" of the finite values."""
    good = scale * np.array([v for v in values if v is not None], dtype=float)
    if good.size == 0:
        return "-"
    text = f"{np.median(good):.3g} ({good.min():.3g} to {good.max():.3g})"
    return f"{text} {unit}".strip()


def with_count(values, bound: float) -> str:
    """median_range, and the number of values that reach the bound."""
    reached = sum(value >= bound for value in values)
    return f"{median_range(values)}; {reached} of {len(values)} reach {bound:g}"
