"""What users imported before systems/ had wings."""

import subprocess
import sys
from importlib import import_module, reload
from importlib.util import find_spec

import pytest

from makebreak.systems.moved import MOVED

# What users' code had reason to import: systems, their configs and what these need.
FORMER = """
    adapt_button arm_reference ball_tracker c3_mpc contact_anticipator contact_detector
    contact_sampler forward_model impedance_controller lcs_builder lcs_plant
    mode_detector pose_tracker residual_learner state_estimator tip_state tool_wrench
    variable_impedance velocity_shaper numerics.c3_mpc numerics.c3_projections
    numerics.contact_task numerics.igmm numerics.lcp numerics.lcs
    numerics.motion_pattern numerics.serial_chain
    numerics.baselines.long_term_predictor
""".split()


@pytest.mark.parametrize("former", FORMER)
def test_a_former_name_is_the_very_module(former):
    old = import_module(f"makebreak.systems.{former}")
    assert old.__name__ == old.__spec__.name == MOVED[f"makebreak.systems.{former}"]
    assert old is import_module(old.__name__)


def test_every_former_name_leads_to_a_module():
    assert len(MOVED) > 90
    for former, present in MOVED.items():
        assert find_spec(present) is not None, former


def test_former_names_are_found_as_attributes_and_reload():
    code = "from makebreak.systems import c3_mpc, residual_learner\n"
    code += "import makebreak.systems.numerics.lcs as lcs\n"
    code += "print(c3_mpc.C3Mpc.__module__, lcs.LCS.__module__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == [
        "makebreak.systems.contact_mpc.c3_mpc",
        "makebreak.systems.contact_mpc.numerics.lcs",
    ], done.stderr
    former = import_module(f"makebreak.systems.{FORMER[0]}")
    assert reload(former) is former


def test_a_name_that_never_was_is_not_found():
    with pytest.raises(ModuleNotFoundError, match="makebreak.systems.never"):
        import_module("makebreak.systems." + "never")
