"""What users imported before systems/ had wings."""

import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec

import pytest

from makebreak.systems.moved import MOVED


@pytest.mark.parametrize("former", ["c3_mpc", "numerics.motion_pattern", "tip_state"])
def test_a_former_name_has_the_very_objects_of_the_present_one(former):
    old = import_module(f"makebreak.systems.{former}")
    new = import_module(MOVED[f"makebreak.systems.{former}"])
    public = [name for name in vars(new) if not name.startswith("__")]
    assert public and all(getattr(old, name) is getattr(new, name) for name in public)
    assert new.__spec__.name == new.__name__ == MOVED[old.__name__]


def test_every_former_name_leads_to_a_module():
    assert len(MOVED) > 90
    for former, present in MOVED.items():
        assert find_spec(present) is not None, former


def test_former_names_are_found_as_attributes_too():
    code = "from makebreak.systems import c3_mpc, residual_learner\n"
    code += "import makebreak.systems.numerics.lcs as lcs\n"
    code += "print(c3_mpc.C3Mpc.__module__, lcs.LCS.__module__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == [
        "makebreak.systems.contact_mpc.c3_mpc",
        "makebreak.systems.contact_mpc.numerics.lcs",
    ], done.stderr


def test_a_name_that_never_was_is_not_found():
    with pytest.raises(ModuleNotFoundError, match="makebreak.systems.never"):
        import_module("makebreak.systems.never")
