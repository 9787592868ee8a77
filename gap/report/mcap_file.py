"""Motions as an MCAP file of ROS 2 messages, which Foxglove, PlotJuggler, RViz and
`ros2 bag` open, and which `makebreak gap` reads as any other log; and as rerun's."""

import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    Mesh,
    ReadObjToTriangleSurfaceMesh,
    Rgba,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from makebreak.gap.data.bags import rosbags
from makebreak.gap.data.recording import QUATERNION, Recording
from makebreak.gap.data.table import TWIST, WRENCH
from makebreak.gap.report.comparison import (
    COLOURS,
    STILL,
    Motion,
    between_samples,
    set_positions,
    shapes_of,
)
from makebreak.models.effects.kind import full_name
from makebreak.models.scene import LoadedScene

FRAMES_HZ = 100.0  # Poses of bodies, at most.
_APART_SEC = 1.0  # Between episodes whose clocks overlap.
_LATEST_SEC = 2.0**31  # What a ROS stamp holds.
_STATE = ("position", "velocity", "effort_measured")
_COMMAND = ("position_command", "velocity_command", "effort_command")
_WORLD = "world"


def motions_of(recording: Recording) -> list[Motion]:
    """What was measured and commanded in each episode of a recording."""
    return [
        Motion(
            recording.name, e.number, recording.time[e.rows], np.array([0]),
            {"measured": {n: recording[n][e.rows] for n in recording.channels}},
            (), 0,
        )
        for e in recording.episodes
    ]  # fmt: skip


def write_mcap(
    path: Path, motions: Sequence[Motion], loaded: Mapping[str, LoadedScene]
) -> list[str]:
    """Writes what moves, a motion after the other.

    Topics, each with the name of who moves before it if more than one does
    (/before/joint_states): joint_states and joint_commands (sensor_msgs/JointState; the
    effort is the measured or the commanded one; NaN where a row has no sample), pose,
    twist and wrench of bodies and frames (stamped, in world), shapes (MarkerArray,
    once) and /tf with the bodies' poses, at most at 100 Hz, straight between samples.
    Stamps are the motions' times [s]; where these overlap, are negative, or later than
    a stamp can be, they are moved, which is said.

    Args: loaded: {who, as in the motions' columns: the scene in which it moves}.
    Returns: sentences of what was moved.
    Raises: ValueError if rosbags, which writes the file, is not installed.
    """
    rosbag2, store = rosbags("rosbag2", f"{path.name}: MCAP needs")
    messages = _Messages(store.types)
    starts, notes = _starts(motions)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        bag = Path(folder) / "bag"
        writer = rosbag2.Writer(
            bag, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP
        )
        writer.set_compression(
            rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD
        )
        with writer:
            topics: dict = {}

            def write(topic, stamp, message):
                kind = message.__msgtype__
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(topics[topic], stamp, store.serialize_cdr(message, kind))

            for k, (motion, start) in enumerate(zip(motions, starts, strict=True)):
                stamps = np.rint(1e9 * (motion.time + start)).astype(np.int64)
                parts: list = []
                for who, columns in motion.columns.items():
                    if who not in loaded:
                        continue
                    before = f"{who}/" if len(loaded) > 1 else ""
                    one = loaded[who]
                    if k == 0:
                        shapes = _shapes(one, before, COLOURS[who])
                        array = messages.shapes(shapes, who, int(stamps[0]))
                        write(f"/{before}shapes", int(stamps[0]), array)
                    parts += messages.readings(columns, stamps, before)
                    parts += messages.poses(columns, stamps, before, one.plant, motion)
                for stamp, topic, message in sorted(parts, key=lambda part: part[0]):
                    write(topic, stamp, message)
        (written,) = bag.glob("*.mcap")
        shutil.move(written, path)
    return notes


def write_rrd(path: Path, mcap: Path, loaded: Mapping[str, LoadedScene]) -> None:
    """Writes an MCAP file of write_mcap as rerun's .rrd, with the shapes, which rerun
    does not read from it. Args: loaded: as of write_mcap.

    Raises: ValueError if rerun is not installed.
    """
    try:
        rerun = import_module("rerun")
    except ImportError:
        raise ValueError(
            f"{path.name}: .rrd needs rerun: pip install 'makebreak[rerun]'"
        ) from None
    recording = rerun.RecordingStream("makebreak")
    recording.save(path)
    recording.log_file_from_path(mcap)
    for who, one in loaded.items():
        before = f"{who}/" if len(loaded) > 1 else ""
        for k, shape in enumerate(_shapes(one, before, COLOURS[who])):
            at, c = f"/shapes/{who}/{k}", shape.colour
            rgba = [round(255 * x) for x in (c.r(), c.g(), c.b(), c.a())]
            x, y, z, w = np.roll(shape.X_FS.rotation().ToQuaternion().wxyz(), -1)
            half = 0.5 * np.asarray(shape.scale)
            placed = {
                "centers": [shape.X_FS.translation()],
                "quaternions": [rerun.Quaternion(xyzw=[x, y, z, w])],
                "colors": [rgba],
                "fill_mode": "solid",
            }
            if shape.kind == "CUBE":
                solid = rerun.Boxes3D(half_sizes=[half], **placed)
            elif shape.kind == "SPHERE":
                solid = rerun.Ellipsoids3D(half_sizes=[half], **placed)
            elif shape.kind == "CYLINDER":
                solid = rerun.Cylinders3D(
                    lengths=[shape.scale[2]], radii=[half[0]], **placed
                )
            else:
                corners = shape.X_FS.multiply(shape.corners.T).T
                solid = rerun.Mesh3D(vertex_positions=corners, albedo_factor=rgba)
            recording.log(at, rerun.CoordinateFrame(shape.frame), static=True)
            recording.log(at, solid, static=True)
    recording.flush(timeout_sec=60.0)
    recording.disconnect()


def _starts(motions: Sequence[Motion]) -> tuple[list[float], list[str]]:
    """[s] by which each motion's times are moved, and what to say of it."""
    first, last = motions[0].time[0], max(float(m.time[-1]) for m in motions)
    all_by = 0.0 if first >= 0.0 and last < _LATEST_SEC else -float(first)
    starts, end = [], -np.inf
    for motion in motions:
        by = all_by
        if motion.time[0] + by <= end:
            by = end + _APART_SEC - float(motion.time[0])
        starts.append(by)
        end = float(motion.time[-1]) + by
    notes = [
        f"episode {m.episode} of {m.recording} is moved by {by:.6g} s"
        for m, by in zip(motions, starts, strict=True)
        if by
    ]
    return starts, notes


class _Messages:
    """Builds messages. Args: types: {name: class} of ROS 2."""

    def __init__(self, types: Mapping):
        self._types = types

    def _of(self, package: str, name: str, *values):
        return self._types[f"{package}/msg/{name}"](*values)

    def _header(self, stamp: int, frame: str):
        time = self._of("builtin_interfaces", "Time", *divmod(stamp, 10**9))
        return self._of("std_msgs", "Header", time, frame)

    def _vector(self, xyz, kind: str = "Vector3"):
        return self._of("geometry_msgs", kind, *(float(x) for x in xyz))

    def _quaternion(self, wxyz):
        w, x, y, z = (float(c) for c in wxyz)
        return self._of("geometry_msgs", "Quaternion", x, y, z, w)

    def _pose(self, place, wxyz):
        return self._of(
            "geometry_msgs", "Pose", self._vector(place, "Point"),
            self._quaternion(wxyz),
        )  # fmt: skip

    def readings(self, columns: Mapping, stamps: np.ndarray, before: str) -> Iterator:
        """(stamp, topic, message) of each row that has samples."""
        for topic, quantities in (
            ("joint_states", _STATE),
            ("joint_commands", _COMMAND),
        ):
            yield from self._joints(f"/{before}{topic}", columns, stamps, quantities)
        places = dict.fromkeys(name.rpartition(".")[0] for name in columns)
        for at in places:
            frame = f"{before}{at.replace('.', '/')}"
            for kind, names in (
                ("pose", ("x", "y", "z", *QUATERNION)),
                ("twist", TWIST),
                ("wrench", WRENCH),
            ):
                there = [f"{at}.{name}" in columns for name in names]
                if not any(there):
                    continue
                rows = np.column_stack([
                    columns.get(f"{at}.{name}", np.full(len(stamps), np.nan))
                    for name in names
                ])  # fmt: skip
                for stamp, row in zip(stamps, rows, strict=True):
                    if np.isfinite(row).any():
                        message = self._stamped(kind, int(stamp), row)
                        yield int(stamp), f"/{kind}/{frame}", message

    def _joints(self, topic: str, columns: Mapping, stamps, quantities) -> Iterator:
        joints = list(dict.fromkeys(
            name.rpartition(".")[0] for name in columns
            if name.rpartition(".")[2] in quantities
        ))  # fmt: skip
        short = [joint.partition(".")[2] for joint in joints]
        names = short if len(set(short)) == len(short) else joints
        unknown = np.full(len(stamps), np.nan)
        values = [
            np.column_stack([columns.get(f"{joint}.{q}", unknown) for joint in joints])
            if any(f"{joint}.{q}" in columns for joint in joints)
            else np.zeros((len(stamps), 0))
            for q in quantities
        ] if joints else []  # fmt: skip
        there = np.zeros(len(stamps), bool)
        for each in values:
            there |= np.isfinite(each).any(axis=1)
        for row in np.flatnonzero(there):
            stamp = int(stamps[row])
            message = self._of(
                "sensor_msgs", "JointState", self._header(stamp, ""), names,
                *(np.array(each[row]) for each in values),
            )  # fmt: skip
            yield stamp, topic, message

    def _stamped(self, kind: str, stamp: int, row: np.ndarray):
        header = self._header(stamp, _WORLD)
        if kind == "pose":
            turn = row[3:] if np.isfinite(row[3:]).all() else np.full(4, np.nan)
            pose = self._pose(row[:3], turn)
            return self._of("geometry_msgs", "PoseStamped", header, pose)
        kind, vectors = kind.title(), (self._vector(row[:3]), self._vector(row[3:]))
        inner = self._of("geometry_msgs", kind, *vectors)
        return self._of("geometry_msgs", f"{kind}Stamped", header, inner)

    def poses(
        self, columns, stamps, before: str, plant: MultibodyPlant, motion: Motion
    ) -> Iterator:
        """(stamp, /tf, message) with the poses of all bodies that have a frame."""
        context = plant.CreateDefaultContext()
        known = {name: between_samples(y, motion) for name, y in columns.items()}
        last = -np.inf
        bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
        for row, stamp in enumerate(stamps):
            if stamp < last + 1e9 / FRAMES_HZ - 1e3:
                continue
            last = float(stamp)
            set_positions(plant, context, known, row)
            transforms = [
                self._transform(
                    int(stamp), _frame(before, plant, body),
                    plant.EvalBodyPoseInWorld(context, body),
                )
                for body in bodies
            ]  # fmt: skip
            yield int(stamp), "/tf", self._of("tf2_msgs", "TFMessage", transforms)

    def _transform(self, stamp: int, child: str, X: RigidTransform):
        transform = self._of(
            "geometry_msgs", "Transform", self._vector(X.translation()),
            self._quaternion(X.rotation().ToQuaternion().wxyz()),
        )  # fmt: skip
        header = self._header(stamp, _WORLD)
        return self._of("geometry_msgs", "TransformStamped", header, child, transform)

    def shapes(self, shapes: Sequence["_Shape"], ns: str, stamp: int):
        """MarkerArray of shapes, each fixed in the frame of its body."""
        markers = [self._marker(stamp, ns, k, one) for k, one in enumerate(shapes)]
        return self._of("visualization_msgs", "MarkerArray", markers)

    def _marker(self, stamp: int, ns: str, number: int, shape: "_Shape"):
        time = self._of("builtin_interfaces", "Time", 0, 0)
        none = self._of("std_msgs", "Header", time, "")
        data = np.zeros(0, np.uint8)
        cls = self._types["visualization_msgs/msg/Marker"]
        c, turn = shape.colour, shape.X_FS.rotation().ToQuaternion().wxyz()
        return cls(
            self._header(stamp, shape.frame), ns, number, getattr(cls, shape.kind),
            cls.ADD, self._pose(shape.X_FS.translation(), turn),
            self._vector(shape.scale),
            self._of("std_msgs", "ColorRGBA", c.r(), c.g(), c.b(), c.a()),
            self._of("builtin_interfaces", "Duration", 0, 0), True,
            [self._vector(p, "Point") for p in shape.corners], [], "",
            self._of("sensor_msgs", "CompressedImage", none, "", data), [], "", "",
            self._of("visualization_msgs", "MeshFile", "", data), False,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Shape:
    """As a marker has it. X_FS: its pose in the frame; scale (3,) [m]; corners (3 n, 3)
    [m]: of the triangles of a TRIANGLE_LIST."""

    frame: str
    kind: str
    X_FS: RigidTransform
    scale: Sequence[float]
    corners: np.ndarray
    colour: Rgba


def _shapes(loaded: LoadedScene, before: str, colour: Rgba) -> list[_Shape]:
    moving, still = shapes_of(loaded)
    placed = [
        (_frame(before, loaded.plant, body), pose, shape, colour)
        for _, body, pose, shape in moving
    ]
    placed += [(_WORLD, body @ pose, shape, STILL) for _, body, pose, shape in still]
    return [
        _Shape(frame, kind, pose @ X, scale, corners, rgba)
        for frame, pose, shape, rgba in placed
        for kind, X, scale, corners in _primitives(shape)
    ]


def _frame(before: str, plant: MultibodyPlant, body) -> str:
    return before + full_name(plant, body).replace(".", "/")


def _primitives(shape) -> Iterator[tuple[str, RigidTransform, Sequence, np.ndarray]]:
    """(kind of marker, its pose in the shape's frame, scale (3,) [m], corners (3 n, 3)
    of triangles [m]) of which a shape is made; none of a shape without an end."""
    same, none = RigidTransform(), np.zeros((0, 3))
    if isinstance(shape, Box):
        yield "CUBE", same, shape.size(), none
    elif isinstance(shape, Sphere):
        yield "SPHERE", same, 3 * [2.0 * shape.radius()], none
    elif isinstance(shape, Ellipsoid):
        yield "SPHERE", same, [2.0 * x for x in (shape.a(), shape.b(), shape.c())], none
    elif isinstance(shape, Cylinder | Capsule):
        wide = 2.0 * shape.radius()
        yield "CYLINDER", same, [wide, wide, shape.length()], none
        if isinstance(shape, Capsule):
            for end in (-0.5, 0.5):
                place = RigidTransform([0.0, 0.0, end * shape.length()])
                yield "SPHERE", place, 3 * [wide], none
    elif isinstance(shape, Mesh | Convex):
        yield "TRIANGLE_LIST", same, [1.0, 1.0, 1.0], _corners(shape)


def _corners(shape: Mesh | Convex) -> np.ndarray:
    """(3 n, 3) corners of a mesh's triangles [m]; of its convex hull, unless it is an
    OBJ file, which alone Drake gives the triangles of."""
    source = shape.source()
    if isinstance(shape, Mesh) and source.is_path() and shape.extension() == ".obj":
        surface = ReadObjToTriangleSurfaceMesh(source.path(), shape.scale3())
    else:
        surface = shape.GetConvexHull()
    corners = []
    for i in range(surface.num_elements()):
        face = surface.element(i)
        n = face.num_vertices()
        points = [surface.vertex(face.vertex(j)) for j in range(n)]
        for b, c in pairwise(points[1:]):
            corners += [points[0], b, c]
    return np.array(corners).reshape(-1, 3)
