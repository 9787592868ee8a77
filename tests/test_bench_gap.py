"""The recording that `makebreak bench gap` is timed with."""

import numpy as np
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.recording import check_against_scene, read_recordings
from makebreak.gap.scene_facts import scene_names
from makebreak.models.scene import load_scene, read_scene
from makebreak.scripts.bench_gap import (
    FRICTION,
    FRICTION_JOINT,
    POSITION_NOISE,
    RATE_HZ,
    record,
    sum_of_sines,
)


def test_the_arm_follows_its_sines_and_its_efforts_hold_friction(tmp_path):
    scene, path = record(tmp_path, seed=3, duration=2.0)
    [recording] = read_recordings([path])
    plant = load_scene(read_scene(scene), DiagramBuilder()).plant
    check_against_scene(recording, *scene_names(plant))
    names = [f"panda.panda_joint{i}" for i in range(1, 8)]
    q = np.stack([recording[f"{n}.position"] for n in names], axis=1)
    u = np.stack([recording[f"{n}.effort_command"] for n in names], axis=1)
    assert len(q) == 2.0 * RATE_HZ
    wanted = sum_of_sines(np.random.default_rng(3))
    time = recording.time
    q_d, v_d, vd_d = (np.stack(x) for x in zip(*map(wanted, time), strict=True))
    # Held back by friction over inertia over stiffness: 1.8/0.5/100 rad at most.
    assert abs(q - q_d)[:, FRICTION_JOINT].max() < 0.05
    others = [i for i in range(7) if i != FRICTION_JOINT]
    assert abs(q - q_d)[:, others].max() < 0.02
    # Its efforts along the way, less those of the wanted motion in a plant without
    # friction: in the mean friction, where the joint moves one way and fast.
    context = plant.CreateDefaultContext()
    extra = []
    for k in np.flatnonzero(abs(v_d[:, FRICTION_JOINT]) > 0.2):
        plant.SetPositions(context, q_d[k])
        plant.SetVelocities(context, v_d[k])
        forces = -plant.CalcGravityGeneralizedForces(context)
        forces += plant.CalcMassMatrix(context) @ vd_d[k]
        forces += plant.CalcBiasTerm(context)
        sign = np.sign(v_d[k, FRICTION_JOINT])
        extra.append(sign * (u[k] - forces)[FRICTION_JOINT])
    # It lags by 0.03 rad, so that it accelerates otherwise and gravity pulls otherwise.
    np.testing.assert_allclose(np.mean(extra[len(extra) // 3 :]), FRICTION, rtol=0.15)
    assert recording.channels[f"{names[0]}.position"].noise < 2.0 * POSITION_NOISE
