"""Logs of MuJoCo's own steps: what its world does, and equations of motion do not."""

import json

import numpy as np
import pytest

from makebreak.scripts.cli import main

mujoco = pytest.importorskip("mujoco", reason="MuJoCo has no wheels for Python 3.10")

# Damping stops it within 20 ms, which is a step.
LIGHT = """<mujoco model="light"><option timestep="0.02"/><worldbody><body name="arm">
<joint name="turn" axis="0 0 1" damping=".01" frictionloss="{friction}" range="-60 60"/>
<geom type="capsule" size=".01" fromto="0 0 0 .12 0 0"/></body></worldbody>
<actuator><motor joint="turn" gear=".05" ctrlrange="-1 1"/></actuator></mujoco>"""


def compared(folder, friction):
    """(verdict, {kind}, what is left, kinds of checks) of a log of 14 s, with friction
    hidden [N m]."""
    (folder / "light.xml").write_text(LIGHT.format(friction=0.0))
    model = mujoco.MjModel.from_xml_string(LIGHT.format(friction=friction))
    data, rng = mujoco.MjData(model), np.random.default_rng(2)
    waves = [(rng.uniform(2, 15), rng.uniform(0, 6)) for _ in range(4)]
    rows = []
    for t in np.arange(0.0, 14.0, 0.02):
        u = 0.22 * sum(np.sin(w * t + p) for w, p in waves)
        rows.append([t, data.qpos[0], data.qvel[0], u])
        data.ctrl[0] = u
        mujoco.mj_step(model, data)
    t, q, v, u = np.transpose(rows)
    noise = rng.normal(size=(2, len(t)))
    columns = {"qpos": q + 1e-4 * noise[0], "qvel": v + 1e-3 * noise[1], "ctrl": u}
    np.savez(
        folder / "log.npz", time=t, **{name: y[:, None] for name, y in columns.items()}
    )
    files = [str(folder / name) for name in ("light.xml", "log.npz")]
    main(["gap", *files, "--out", str(folder / "out")])
    result = json.loads((folder / "out" / "result.json").read_text())
    return (
        result["verdict"], {e["kind"] for e in result["effects"]},
        result["gap"]["after"], {check["kind"] for check in result["checks"]},
    )  # fmt: skip


def test_what_mujocos_steps_do_is_no_gap(tmp_path):
    verdict, effects, left, checks = compared(tmp_path, 0.0)
    assert (verdict, effects) == ("no_gap", set())
    assert left < 1.0 and {"mujoco_contacts", "velocity_lag"} <= checks


def test_a_friction_is_named_beside_such_steps(tmp_path):
    verdict, effects, left, _ = compared(tmp_path, 0.004)
    assert (verdict, effects) == ("gap_named", {"joint_coulomb_friction"})
    assert left < 3.0
