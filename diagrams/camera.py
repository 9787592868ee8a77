"""The overhead camera: rendered by VTK if that works on this machine, else drawn."""

import functools
import subprocess
import sys
from dataclasses import dataclass, field

import cv2
import numpy as np
from pydrake.geometry import (
    ClippingRange,
    LightParameter,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
    SceneGraph,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.sensors import CameraInfo

from makebreak.systems.perception.camera_shake import CameraShake
from makebreak.systems.perception.numerics.pinhole import Pinhole, look_down
from makebreak.systems.perception.pinhole_camera import PinholeCamera
from makebreak.systems.perception.region_camera import RegionCamera

# Drake's VTK images are shifted by half a pixel towards -u and -v against their
# CameraInfo (tests/test_camera.py measures it); the drawn images have the same shift.
VTK_CENTER_SHIFT = -0.5  # [px]

# On images this small OpenCV's threads gain nothing but spin while they wait: a tenth
# of a run's CPU time. The results are the same.
cv2.setNumThreads(1)

# Runs in a process of its own: with libegl1 but without Mesa's drivers Drake does not
# raise an error but crashes.
_PROBE = """
from pydrake.geometry import (ClippingRange, ColorRenderCamera, MakeRenderEngineVtk,
                              RenderCameraCore, RenderEngineVtkParams)
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo, ImageRgba8U
engine = MakeRenderEngineVtk(RenderEngineVtkParams())
core = RenderCameraCore("", CameraInfo(8, 8, 1.0), ClippingRange(0.1, 1.0),
                        RigidTransform())
engine.RenderColorImage(ColorRenderCamera(core, False), ImageRgba8U(8, 8))
"""


@dataclass
class CameraNoise:
    """A random shift of each image, as a whole."""

    # Standard deviation of each image's random shift along u and v, as a length at
    # noise.height [m]; in ball_rolling ball_noise_m sets it.
    position_m: float = 0.0
    # Height above the world's z = 0 at which noise.position_m is measured [m].
    height: float = 0.0315


@dataclass
class CameraConfig:
    """The overhead camera: image, place, renderer, noise."""

    width: int = 320  # Width of the image [px].
    height: int = 240  # Height of the image [px].
    # Angle of view along the image's height, which is the world's x [rad].
    fov_y: float = 0.7
    # Position of the camera in the world; it looks straight down [m].
    position: list[float] = field(default_factory=lambda: [0.5, 0.0, 0.8])
    # Renderer of the images: vtk, drawn, or auto: vtk where it works, else drawn.
    renderer: str = "auto"
    noise: CameraNoise = field(default_factory=CameraNoise)
    # Period of the images, each with a random shift of its own [s]; fixed in
    # ball_rolling.
    period_sec: float = 0.0125


@functools.cache
def vtk_works() -> bool:
    """Whether Drake can render on this machine; tried once, in its own process."""
    try:
        probe = subprocess.run(
            [sys.executable, "-c", _PROBE], capture_output=True, timeout=120
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return probe.returncode == 0


def resolve_renderer(config: CameraConfig) -> str:
    """ "vtk" or "drawn": the renderer that this config gives on this machine.

    Raises: ValueError for an unknown name, or "vtk" where Drake cannot render.
    """
    if config.renderer not in ("auto", "vtk", "drawn"):
        raise ValueError(
            f"camera.renderer is {config.renderer!r}, expected auto, vtk or drawn"
        )
    if config.renderer == "drawn":
        return "drawn"
    if vtk_works():
        return "vtk"
    if config.renderer == "vtk":
        raise ValueError(
            "camera.renderer is 'vtk', but Drake cannot render here (it needs the "
            "packages libegl1 and libgl1-mesa-dri); expected auto or drawn"
        )
    return "drawn"


def describe_camera(config: CameraConfig) -> str:
    """The camera as in result.json: "vtk 320x240"."""
    return f"{resolve_renderer(config)} {config.width}x{config.height}"


def camera_model(config: CameraConfig) -> Pinhole:
    """The pinhole model of the images of either renderer."""
    return look_down(
        config.width, config.height, config.fov_y, config.position, VTK_CENTER_SHIFT
    )


def add_camera(
    builder: DiagramBuilder,
    scene_graph: SceneGraph,
    plant: MultibodyPlant,
    config: CameraConfig,
    seed: int,
    name: str = "overhead",
) -> OutputPort:
    """Adds a camera that looks straight down, the world's +x up in its image.

    Args: plant: finalized; seed: of the random shifts; name: of the systems.
    Returns: the abstract ImageRgba8U port; an image is rendered when it is evaluated.
    Raises: ValueError for a setting out of range.
    """
    if not config.noise.position_m >= 0.0:
        raise ValueError(
            f"noise.position_m must be at least 0, got {config.noise.position_m}"
        )
    if len(config.position) != 3 or not np.isfinite(config.position).all():
        raise ValueError(f"camera position must be 3 numbers, got {config.position}")
    depth = config.position[2] - config.noise.height
    if not depth > 0.0:
        raise ValueError(
            f"the camera at height {config.position[2]} must be above noise.height, "
            f"{config.noise.height}"
        )
    camera = camera_model(config)
    if resolve_renderer(config) == "vtk":
        port = _add_vtk(builder, scene_graph, config, camera, name)
    else:
        drawn = builder.AddNamedSystem(
            f"{name}_camera", PinholeCamera(camera, plant, scene_graph)
        )
        builder.Connect(
            plant.get_body_poses_output_port(), drawn.GetInputPort("body_poses")
        )
        port = drawn.GetOutputPort("rgb_image")
    if config.noise.position_m == 0.0:
        return port
    shift_std_px = config.noise.position_m * camera.focal / depth
    shake = builder.AddNamedSystem(
        f"{name}_shake",
        CameraShake(config.width, config.height, shift_std_px, seed, config.period_sec),
    )
    builder.Connect(port, shake.GetInputPort("image"))
    return shake.GetOutputPort("rgb_image")


def _add_vtk(builder, scene_graph, config, camera, name):
    renderer = f"{name}_renderer"
    # One point light at the camera lights a sphere symmetrically wherever it is in the
    # image. Drake's default, a directional light, shifts the centre of a sphere's image
    # outwards. Each further light would cost a tenth of the time.
    light = LightParameter(type="point", frame="camera")
    engine = MakeRenderEngineVtk(RenderEngineVtkParams(lights=[light]))
    scene_graph.AddRenderer(renderer, engine)
    core = RenderCameraCore(
        renderer,
        CameraInfo(config.width, config.height, config.fov_y),
        ClippingRange(0.01, 10.0),
        RigidTransform(),
    )
    X_WC = RigidTransform(RotationMatrix(camera.R_WC), camera.p_WC)
    sensor = builder.AddNamedSystem(
        f"{name}_camera", RegionCamera(scene_graph.world_frame_id(), X_WC, core)
    )
    builder.Connect(scene_graph.get_query_output_port(), sensor.GetInputPort("query"))
    return sensor.GetOutputPort("rgb_image")
