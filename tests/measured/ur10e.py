"""Recordings of a UR10e arm, with and without a load, as `makebreak gap` reads them.

    git clone https://github.com/shamilmamedov/dynamic_calibration
    python tests/measured/ur10e.py dynamic_calibration OUT

writes OUT/ur10e.urdf, and OUT/<name>.csv with OUT/<name>.yaml for each of NAMES. The
files have no header; their columns are time, positions, velocities, motor currents,
and the desired currents and torques of a controller, which are left out.
"""

import argparse
from pathlib import Path

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
# Torque at the joint for a motor's current [N m/A]: figures of another UR10, which the
# authors of the data give beside their own estimate (main.m).
GAINS = (14.87, 13.26, 11.13, 10.62, 11.03, 11.47)
# File and rows that the authors use, of 100 a second.
NAMES = {
    "free": ("identification_data/ur-20_02_19_14harm50sec.csv", 195, 4966),
    "load": ("identification_data/ur-20_02_19_14harm50secLoad.csv", 308, 5071),
    "points": ("validation_data/ur-20_01_17-ptp_10_points.csv", 700, 4200),
    "other": ("identification_data/ur-20_02_10-30sec_12harm.csv", 635, 3510),
}
LOAD = 2.805  # [kg], as the authors say (estimate_drive_gains.m).


def sidecar() -> str:
    """Of columns that are numbered, because nobody named them."""
    lines = ["columns:", "  column_1: time"]
    for k, joint in enumerate(JOINTS):
        at = f"ur10e.{joint}_joint"
        effort = f"{{channel: {at}.effort_measured, scale: {GAINS[k]}}}"
        lines.append(f"  column_{2 + k}: {at}.position")
        lines.append(f"  column_{8 + k}: {at}.velocity")
        lines.append(f"  column_{14 + k}: {effort}")
        lines += [f"  column_{n + k}: null" for n in (20, 26)]
    lines.append("provenance: UR10e, github.com/shamilmamedov/dynamic_calibration")
    return "\n".join(lines) + "\n"


def convert(data: Path, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    urdf = (data / "URe/urdf/ur10e.urdf").read_text()
    (out / "ur10e.urdf").write_text(urdf)
    for name, (file, first, last) in NAMES.items():
        rows = (data / "dataset_ur10e" / file).read_text().splitlines()
        (out / f"{name}.csv").write_text("\n".join(rows[first - 1 : last]) + "\n")
        (out / f"{name}.yaml").write_text(sidecar())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    convert(args.data, args.out)


if __name__ == "__main__":
    main()
