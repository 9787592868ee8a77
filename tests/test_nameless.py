"""Tables without names: columns by what is in them."""

import numpy as np
import pytest
import yaml
from front_doors import exact

from makebreak.gap.data.robot import propose_scene, read_log, read_robot

WHAT = {"position": "position", "velocity": "velocity", "effort": "effort_measured"}


def proposed(folder, blocks, by_joint=False, timed=True):
    """What is proposed for the columns of a log of three joints, and what is said; and
    the names that these columns should have. blocks: of what, or numbers (n, 3)."""
    path, log = exact("three", folder, np.random.default_rng(4))
    columns, names = [], []
    for block in blocks:
        for i in (1, 2, 3):
            if isinstance(block, str):
                columns.append(log.columns[f"joint{i}_{block}"])
                names.append(f"arm.joint{i}.{WHAT[block]}")
            else:
                columns.append(block(log.columns[f"joint{i}_position"], i))
                names.append(None)
    order = np.arange(3 * len(blocks)).reshape(-1, 3)
    order = (order.T if by_joint else order).ravel()
    table = np.stack(columns, axis=1)[:, order]
    file = folder / "log.csv"
    if timed:
        table = np.column_stack([log.time, table])
    else:
        (folder / "log.yaml").write_text("rate_hz: 100\n")
    np.savetxt(file, table, delimiter=" ", fmt="%.9g")
    read = read_log(file)
    proposal = propose_scene(read_robot(path), [read])
    own = yaml.safe_load(proposal.sidecars[file])["columns"]
    found = [own[f"column_{k + 1 + timed}"] for k in range(len(order))]
    found = [x["channel"] if isinstance(x, dict) else x for x in found]
    said = [s.says for s in proposal.said if s.kind == "columns_unnamed"]
    return found, [names[k] for k in order], said


@pytest.mark.parametrize("by_joint", [False, True])
@pytest.mark.parametrize("timed", [False, True])
@pytest.mark.parametrize(
    "blocks",
    [
        ("position", "velocity", "effort"),
        ("effort", "velocity", "position"),
        ("position", "effort"),
        ("effort", "position"),
    ],
)
def test_columns_are_known_by_the_motion_and_the_model(
    tmp_path, blocks, by_joint, timed
):
    found, expected, said = proposed(tmp_path, blocks, by_joint, timed)
    assert found == expected
    assert "log.csv names no columns" in said[0]


def test_accelerations_and_what_says_nothing_are_left_out(tmp_path):
    def rate(q, i):
        return np.gradient(np.gradient(q, 0.01), 0.01)

    def other(q, i):
        return np.random.default_rng(i).normal(size=len(q)).cumsum()

    blocks = (other, "position", "velocity", rate, "effort")
    found, expected, _ = proposed(tmp_path, blocks)
    assert found == expected


def test_commands_are_what_positions_follow(tmp_path):
    def command(q, i):
        return np.append(q[3:], q[-3:])

    found, expected, _ = proposed(tmp_path, ("position", "velocity", command))
    expected[-3:] = [f"arm.joint{i}.position_command" for i in (1, 2, 3)]
    assert found == expected


def test_columns_that_could_be_efforts_as_well_are_named(tmp_path):
    path, log = exact("three", tmp_path, np.random.default_rng(4))

    def also(q, i):  # As currents beside the torques that a controller wanted.
        tau = log.columns[f"joint{i}_effort"]
        return 0.1 * (tau + 0.2 * np.std(tau) * np.random.default_rng(i).normal())

    found, expected, said = proposed(tmp_path, ("position", "velocity", also, "effort"))
    assert found == expected and "column_8 could be the efforts as well" in said[0]


@pytest.mark.parametrize("names", [("x", "u"), ("state", "input"), ("data", "tau")])
def test_a_state_and_inputs_that_are_one_fewer_are_read(tmp_path, names):
    """As control has them: x of n + 1 instants, u between them, and a step."""
    path, log = exact("three", tmp_path, np.random.default_rng(4))
    x = [
        log.columns[f"joint{i}_{w}"]
        for w in ("position", "velocity")
        for i in (1, 2, 3)
    ]
    u = [log.columns[f"joint{i}_effort"][:-1] for i in (1, 2, 3)]
    file = tmp_path / "log.npz"
    np.savez(file, **dict(zip(names, (np.array(x), np.array(u)), strict=True)), dt=0.01)
    proposal = propose_scene(read_robot(path), [read_log(file)])
    own = yaml.safe_load(proposal.sidecars[file])["columns"]
    for k in range(6):
        what = "position" if k < 3 else "velocity"
        assert own[f"{names[0]}[{k}]"] == f"arm.joint{k % 3 + 1}.{what}"
    for k in range(3):
        assert own[f"{names[1]}[{k}]"].startswith(f"arm.joint{k + 1}.effort_")


def test_an_array_of_its_own_is_read(tmp_path):
    path, log = exact("three", tmp_path, np.random.default_rng(4))
    what = [(w, i) for w in ("position", "velocity", "effort") for i in (1, 2, 3)]
    table = [log.time, *(log.columns[f"joint{i}_{w}"] for w, i in what)]
    np.save(tmp_path / "log.npy", np.array(table).T)
    read = read_log(tmp_path / "log.npy")
    sidecar = propose_scene(read_robot(path), [read]).sidecars[read.path]
    own = yaml.safe_load(sidecar)["columns"]
    assert own["column[0]"] == "time" and own["column[9]"].startswith("arm.joint3.eff")
    np.save(tmp_path / "objects.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(ValueError, match="pickled objects"):
        read_log(tmp_path / "objects.npy")


def test_numbers_that_are_no_motion_are_refused(tmp_path):
    def noise(q, i):
        return np.random.default_rng(i).normal(size=len(q))

    with pytest.raises(ValueError, match="no column looks like the position"):
        proposed(tmp_path, (noise, noise, noise))
