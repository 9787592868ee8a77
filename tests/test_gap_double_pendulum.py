"""Two links that swing, measured on a real rig: what the workflow makes of them.

The data are those of the DFKI double pendulum (Wiebe et al., RA-L 2024; design A.0, BSD
3-Clause). They are no part of the repository.
"""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from measured.double_pendulum import convert

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.simulation.judge import judge
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene
from makebreak.scripts.cli import commands as cli

FOLDER = Path(__file__).resolve().parents[2] / "shared/data"
DATA = Path(os.environ.get("MAKEBREAK_DATA", FOLDER)) / "double_pendulum_A0.npz"
JOINTS = ("arm.shoulder", "arm.elbow")

pytestmark = pytest.mark.skipif(
    not DATA.is_file(),
    reason=f"the measured double pendulum is not here: no {DATA.name} in "
    "../shared/data or $MAKEBREAK_DATA",
)


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rig")
    convert(DATA, folder)
    return folder


def runs(folder, *numbers):
    return [str(folder / f"run_{number}.csv") for number in numbers]


def position_errors(scene, recordings):
    of = {j.channel: j.rms for j in judge(scene, recordings, 0.4)}
    return np.array([of[f"{joint}.position"] for joint in JOINTS])


@pytest.mark.parametrize(
    ("coulomb", "expected"),
    [((0.0, 0.0), (0.057, 0.203)), ((0.116, 0.162), (0.021, 0.062))],
)
def test_windows_err_as_was_found_by_other_code(rig, coulomb, expected):
    """Without friction and with the Coulomb friction that another program, with its own
    windows and its own filter, fitted to these data. How their starts are smoothed
    differs: a fifth of the error."""
    scene = read_scene(rig / "scene.yaml")
    effects = [
        Effect("joint_coulomb_friction", [joint], {"coulomb": value})
        for joint, value in zip(JOINTS, coulomb, strict=True)
        if value
    ]
    scene = replace(scene, effects=effects)
    recordings = read_recordings(runs(rig, "05", "12", "13"))
    np.testing.assert_allclose(position_errors(scene, recordings), expected, rtol=0.2)


@pytest.mark.slow
def test_dry_friction_of_both_joints_is_named_and_predicts_other_runs(rig, tmp_path):
    out = tmp_path / "out"
    words = ["gap", str(rig / "scene.yaml"), *runs(rig, "00", "01", "02", "03", "04")]
    assert cli.main([*words, "--out", str(out)]) == 0
    found = json.loads((out / "result.json").read_text())["effects"]
    dry = [e["at"] for e in found if e["kind"] == "joint_coulomb_friction"]
    assert sorted(dry) == sorted(JOINTS)
    recordings = read_recordings(runs(rig, "05", "12", "13"))
    after = position_errors(read_scene(out / "scene.yaml"), recordings)
    assert after[0] <= 0.027 and after[1] <= 0.075
