"""Scene and recordings of the DFKI double pendulum, from its npz, for the workflow.

    python tests/measured/double_pendulum.py DATA.npz OUT

writes OUT/scene.yaml with the published inertias and no friction, and run_<nn>.csv of
each run: time, positions, velocities and the motors' measured effort.
"""

import argparse
import json
from pathlib import Path

import numpy as np

_MASS, _LENGTH, _COM = (0.5594, 0.6043), (0.3, 0.2), (0.3, 0.18378)
_INERTIA = (0.05347, 0.02392)  # About the joint.
_ROTOR = 7.66e-5 * 6.0**2
_NAMES = (
    "time", "arm.shoulder.position", "arm.elbow.position", "arm.shoulder.velocity",
    "arm.elbow.velocity", None, None, "arm.shoulder.effort_measured",
    "arm.elbow.effort_measured",
)  # fmt: skip


def _urdf() -> str:
    links, joints = "", ""
    for k, (name, joint, parent) in enumerate(
        (("upper", "shoulder", "base"), ("lower", "elbow", "upper"))
    ):
        about = max(_INERTIA[k] - _MASS[k] * _COM[k] ** 2, 1e-4)
        links += (
            f'<link name="{name}"><inertial><origin xyz="0 0 {-_COM[k]}"/>'
            f'<mass value="{_MASS[k]}"/><inertia ixx="{about}" iyy="{about}" '
            f'izz="{0.5 * about}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
        z = 0.0 if k == 0 else -_LENGTH[0]
        joints += (
            f'<joint name="{joint}" type="continuous"><parent link="{parent}"/>'
            f'<child link="{name}"/><origin xyz="0 0 {z}"/><axis xyz="0 1 0"/>'
            f'<limit effort="20" velocity="100"/></joint>'
            f'<transmission name="t{k}"><type>SimpleTransmission</type>'
            f'<joint name="{joint}"/><actuator name="{joint}">'
            f'<drake:rotor_inertia value="{_ROTOR}"/></actuator></transmission>'
        )
    return (
        '<robot name="arm" xmlns:drake="http://drake.mit.edu"><link name="base"/>'
        f"{links}{joints}</robot>\n"
    )


def convert(data: Path, out: Path) -> list[Path]:
    """Returns: the recordings, in the order of the runs."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "arm.urdf").write_text(_urdf())
    (out / "scene.yaml").write_text(
        "directives:\n"
        "  - add_model: {name: arm, file: arm.urdf}\n"
        "  - add_weld: {parent: world, child: arm::base}\n"
        "plant:\n  time_step: 0.0\n"
        "actuation:\n  type: effort\n  joints: [arm.shoulder, arm.elbow]\n"
        "tolerance:\n  link_mass: 0.03\n  link_com_m: 0.002\neffects: []\n"
    )
    runs = np.load(data)
    files = []
    for key in sorted(runs.files):
        table = np.asarray(runs[key], float)
        table = table[np.concatenate([[True], np.diff(table[:, 0]) > 0])]
        keep = [k for k, name in enumerate(_NAMES) if name]
        header = ",".join(_NAMES[k] for k in keep)
        file = out / f"run_{key.rsplit('_', 1)[-1]}.csv"
        np.savetxt(file, table[:, keep], delimiter=",", header=header, comments="")
        files.append(file)
    return files


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    print(json.dumps([str(f) for f in convert(args.data, args.out)]))


if __name__ == "__main__":
    main()
