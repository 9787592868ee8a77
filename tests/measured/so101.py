"""Scene and recordings of an SO-101 arm, from the csv files of its motions.

    python tests/measured/so101.py DATA_FOLDER OUT

writes OUT/<motion>.csv with positions and position commands, OUT/<motion>.yaml beside
it, OUT/scene.yaml with the servo of the data sheet and OUT/published.yaml with the one
of a published MuJoCo model, OUT/by_hand.yaml with one that was fitted
by hand. In alphabetical order every other motion, from the first, is for fitting
(FITTED), the rest for judging (JUDGED).
"""

import argparse
import csv
import gzip
import json
from pathlib import Path

import numpy as np

MOTIONS = (
    "backlash_detection", "chirp_sweep", "friction_gravity", "gripper_cycles",
    "large_amplitude", "multisine", "prbs_excitation", "single_joint_rotation",
    "static_holding", "trapezoidal_profile",
)  # fmt: skip
FITTED, JUDGED = MOTIONS[::2], MOTIONS[1::2]
JOINTS = (
    "shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll",
    "gripper",
)  # fmt: skip
STEP = 2.0 * np.pi / 4096.0  # [rad] of the encoder.
# The gripper is recorded from 0 to 1 over 1523 steps, from the URDF's lower limit.
GRIPPER = (-0.174533, 1523 * STEP)
# Where the arm lies on the table [s].
IGNORE = {"large_amplitude": [(31.0, 34.0), (102.0, 109.0)]}

# The 12 V servo's data sheet: 2.94 N m stalled, 4.7 rad/s without load; the duty cycle
# is 0.166 x P x error, at most 0.97, with P = 16; the gripper's at most half. Its rotor
# as of a servo of 7.4 V on a test bench (Rhoban/bam).
STALL, FREE, DUTY, GAIN, VOLTAGE, ROTOR = 2.94, 4.7, 0.97, 0.166 * 16, 12.0, 0.0284
# SO-ARM100's joints_properties.xml, for P = 32 and 7.4 V. A duty cycle goes with P, and
# its torque with the voltage.
PUBLISHED = {"kp": 17.8, "damping": 0.60, "coulomb": 0.052, "rotor": 0.028}

# Six numbers for all joints, by one Gauss-Newton step on 50 simulated windows of 0.5 s
# of the motions for fitting; docs/lab/results.md.
BY_HAND = (
    ("servo_gain", "kp", 13.46),
    ("joint_load_friction", "share", 0.817),
    ("joint_coulomb_friction", "coulomb", 0.0997),
    ("input_delay", "delay", 0.0009),
    ("joint_viscous_damping", "damping", 0.0467),
    ("rotor_inertia", "inertia", -0.0182),
)


def _table(folder: Path, motion: str, file: str):
    """time (n,) [s] and positions (n, 6) [rad]."""
    with gzip.open(folder / f"{motion}_{file}.csv.gz", "rt") as text:
        rows = list(csv.DictReader(text))
    q = np.array([json.loads(row["positions"]) for row in rows])
    q[:, 5] = GRIPPER[0] + GRIPPER[1] * q[:, 5]
    return 1e-6 * np.array([float(row["timestamp"]) for row in rows]), q


def convert_motion(folder: Path, motion: str, out: Path) -> Path:
    """Writes the recording and its sidecar. A goal acts from the next row on, as a
    whole step that is cut off and not rounded."""
    time, goals = _table(folder, motion, "control")
    same, measured = _table(folder, motion, "state_motor")
    n = min(len(time), len(same))
    time, goals, measured = time[1:n], goals[: n - 1] - 0.5 * STEP, measured[1:n]
    time = time - time[0]
    keep = np.concatenate([[True], np.diff(time) > 0.0])
    header = ["time"]
    header += [f"so101.{joint}.position" for joint in JOINTS]
    header += [f"so101.{joint}.position_command" for joint in JOINTS]
    file = out / f"{motion}.csv"
    np.savetxt(
        file, np.column_stack([time, measured, goals])[keep], fmt="%.6f",
        delimiter=",", header=",".join(header), comments="",
    )  # fmt: skip
    lines = ["noise:"]
    lines += [f"  so101.{j}.position: {STEP / np.sqrt(12.0):.3g}" for j in JOINTS]
    if motion in IGNORE:
        spans = ", ".join(f"{{from: {a}, to: {b}}}" for a, b in IGNORE[motion])
        lines.append(f"ignore: [{spans}]")
    lines.append("provenance: SO-101, isaac-sim2real/sage, Apache License 2.0")
    file.with_suffix(".yaml").write_text("\n".join(lines) + "\n")
    return file


def _scene(kp: float, limit: float, emf: float, effects: str) -> str:
    """A scene whose supply stalls at `limit` [N m] and loses emf [N m s/rad]."""
    kt = VOLTAGE * emf / limit
    resistance = kt**2 / emf
    joints = ", ".join(f"so101.{joint}" for joint in JOINTS)
    ceiling = [round(DUTY * limit, 3)] * 5 + [round(0.5 * limit, 3)]
    return f"""directives:
  - add_model: {{name: so101, file: so101.urdf}}
  - add_weld: {{parent: world, child: so101::base_link}}
plant: {{time_step: 0.0}}
actuation:
  type: servo
  joints: [{joints}]
  kp: {kp:.3g}
  limit: {ceiling}
  supply: {{voltage: {VOLTAGE}, kt: {kt:.4g}, resistance: {resistance:.4g}}}
  resolution: {STEP:.6g}
tolerance: {{link_mass: 0.1, link_com_m: 0.005}}
effects: {effects}
"""


def write_scenes(folder: Path, out: Path) -> None:
    """scene.yaml, published.yaml and by_hand.yaml, and the URDF beside them."""
    urdf = (folder / "so101_new_calib_no_meshes.urdf").read_text()
    (out / "so101.urdf").write_text(urdf)
    rotor = "\n  - {kind: rotor_inertia, at: so101, parameters: {inertia: %g}}"
    text = _scene(GAIN * STALL, STALL, STALL / FREE, rotor % ROTOR)
    (out / "scene.yaml").write_text(text)
    p = PUBLISHED
    kp = p["kp"] * (16 / 32) * (VOLTAGE / 7.4)
    dry = "\n  - {kind: joint_coulomb_friction, at: so101, parameters: {coulomb: %g}}"
    effects = rotor % p["rotor"] + dry % p["coulomb"]
    text = _scene(kp, kp / GAIN, p["damping"], effects)
    (out / "published.yaml").write_text(text)
    effects = rotor % ROTOR + "".join(
        f"\n  - {{kind: {kind}, at: so101, parameters: {{{name}: {value}}}}}"
        for kind, name, value in BY_HAND
    )
    text = _scene(GAIN * STALL, STALL, STALL / FREE, effects)
    (out / "by_hand.yaml").write_text(text)


def convert(folder: Path, out: Path) -> dict[str, Path]:
    """Returns: the recordings by motion."""
    out.mkdir(parents=True, exist_ok=True)
    write_scenes(folder, out)
    return {motion: convert_motion(folder, motion, out) for motion in MOTIONS}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    convert(args.data, args.out)


if __name__ == "__main__":
    main()
