"""scripts/setup.sh, run.sh and test.sh, with a stand-in for Python that records what it
is asked to do; and the lock files."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from makebreak.scripts.cli.commands import _COMMANDS

ROOT = Path(__file__).resolve().parent.parent
LOCKS = {"1.51": "requirements.lock", "1.58": "requirements-drake-1.58.lock"}

# Answers like a Python that lacks nothing. Each call is a line of calls.txt; a file
# `fail` makes pip fail with that output, a file `kill` kills the set-up in pip.
STAND_IN = r"""#!/bin/bash
here="$STAND_IN_DIR"
case "$1 ${2:-}" in
    "-c import sys"*) echo "${STAND_IN_VERSION:-3.12}" ;;
    "- ") [[ ! -e "$here/missing" ]] || cat "$here/missing" ;;
    "-c "*) echo check >>"$here/calls.txt" ;;
    "-m venv")
        echo venv >>"$here/calls.txt"
        mkdir -p "$3/bin"
        cp "$here/python" "$3/bin/python"
        printf '#!/bin/bash\nprintf "%%s\\n" "$@" "$PWD"\n' >"$3/bin/makebreak"
        chmod +x "$3/bin/makebreak"
        ;;
    "-m pip")
        echo pip >>"$here/calls.txt"
        echo "$*" >>"$here/pip.txt"
        if [[ -e "$here/kill" ]]; then kill -KILL $PPID; exit 1; fi
        if [[ -e "$here/fail" ]]; then cat "$here/fail"; exit 1; fi
        ;;
    "-m pytest") printf '%s\n' "${@:3}" "$PWD" ;;
esac
"""

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="the scripts are for Debian and Ubuntu"
)


class Checkout:
    """A copy of what the set-up reads, in a folder with a space in its name."""

    def __init__(self, folder):
        self.folder = folder
        self.tools = folder.parent / "tools"
        for path in ("scripts", "tools"):
            (folder.parent / path).mkdir()
        folder.mkdir()
        (folder / "scripts").mkdir()
        for name in ("setup.sh", "run.sh", "test.sh"):
            shutil.copy(ROOT / "scripts" / name, folder / "scripts" / name)
        for name in ("pyproject.toml", *LOCKS.values()):
            shutil.copy(ROOT / name, folder / name)
        python = self.tools / "python"
        python.write_text(STAND_IN)
        python.chmod(0o755)

    def __call__(self, script, *arguments, **environment):
        environment = {
            "STAND_IN_DIR": str(self.tools),
            "MAKEBREAK_PYTHON": str(self.tools / "python"),
            "TMPDIR": str(self.tools),
            "PATH": os.environ["PATH"],
            **environment,
        }
        return subprocess.run(
            [self.folder / "scripts" / script, *arguments],
            cwd=self.tools,
            env=environment,
            capture_output=True,
            text=True,
        )

    def calls(self):
        """What Python was asked since the last time."""
        path = self.tools / "calls.txt"
        calls = path.read_text().split() if path.exists() else []
        path.unlink(missing_ok=True)
        return calls


@pytest.fixture
def checkout(tmp_path):
    return Checkout(tmp_path / "a checkout")


def test_first_call_sets_up_and_the_second_does_nothing(checkout):
    done = checkout("setup.sh")
    assert done.returncode == 0, done.stderr
    assert checkout.calls() == ["venv", "pip", "pip", "check"]
    assert (checkout("setup.sh").stderr, checkout.calls()) == ("", [])
    assert list(checkout.tools.glob("makebreak-setup.*")) == []  # No log is left.


@pytest.mark.parametrize("name", ["pyproject.toml", "requirements.lock"])
def test_changed_dependencies_are_installed_into_the_same_venv(checkout, name):
    checkout("setup.sh")
    checkout.calls()
    with (checkout.folder / name).open("a") as file:
        file.write("# changed\n")
    assert checkout("setup.sh").returncode == 0
    assert checkout.calls() == ["pip", "pip", "check"]


def test_interrupted_set_up_starts_again_from_nothing(checkout):
    (checkout.tools / "kill").touch()
    assert checkout("setup.sh").returncode != 0
    (checkout.folder / ".venv" / "half_a_package").touch()
    (checkout.tools / "kill").unlink()
    checkout.calls()
    assert checkout("setup.sh").returncode == 0
    assert checkout.calls() == ["venv", "pip", "pip", "check"]
    assert not (checkout.folder / ".venv" / "half_a_package").exists()


def test_moved_checkout_gets_a_new_venv(checkout):
    checkout("setup.sh")
    checkout.calls()
    checkout.folder = checkout.folder.rename(checkout.folder.with_name("elsewhere"))
    assert checkout("setup.sh").returncode == 0
    assert checkout.calls() == ["venv", "pip", "pip", "check"]


def test_network_failure_is_one_line(checkout):
    failure = (
        "WARNING: Retrying (Retry(total=0)) after connection broken\nERROR: none\n"
    )
    (checkout.tools / "fail").write_text(failure)
    done = checkout("setup.sh")
    first, last = done.stderr.splitlines()
    assert (done.returncode, done.stdout) == (4, "")
    assert "index cannot be reached; check the network" in last
    assert "setting up .venv" in first


def test_a_certificate_that_is_not_trusted_is_told_from_a_missing_network(checkout):
    """Seen behind a proxy that signs anew what passes it."""
    failure = (
        "WARNING: Retrying (Retry(total=0)) after connection broken by 'SSLError("
        "SSLCertVerificationError(1, '[SSL: CERTIFICATE_VERIFY_FAILED] certificate "
        "verify failed: self-signed certificate in certificate chain'))'\n"
    )
    (checkout.tools / "fail").write_text(failure)
    done = checkout("setup.sh")
    assert done.returncode == 4
    assert "certificate is not trusted" in done.stderr.splitlines()[-1]
    assert "PIP_CERT" in done.stderr.splitlines()[-1]


def test_other_pip_failure_gives_its_last_error(checkout):
    (checkout.tools / "fail").write_text("ERROR: a\nERROR: disk is full\nhint\n")
    done = checkout("run.sh")
    assert done.returncode == 4
    assert "pip failed: ERROR: disk is full (log: " in done.stderr.splitlines()[-1]


def test_unsuitable_python_is_refused_by_version(checkout):
    done = checkout("setup.sh", STAND_IN_VERSION="3.9")
    assert done.returncode == 4
    assert "is Python 3.9, expected 3.10 to 3.14" in done.stderr
    assert checkout.calls() == []


def test_newer_drake_is_installed_when_asked_for_and_kept_until_another_is(checkout):
    def installed():
        path = checkout.tools / "pip.txt"
        lines = path.read_text().splitlines() if path.exists() else []
        path.unlink(missing_ok=True)
        return [name for line in lines for name in LOCKS.values() if f"/{name}" in line]

    assert checkout("setup.sh", MAKEBREAK_DRAKE="1.58").returncode == 0
    assert installed() == [LOCKS["1.58"]]
    assert checkout("setup.sh").returncode == 0
    assert installed() == []
    assert checkout("setup.sh", MAKEBREAK_DRAKE="1.51").returncode == 0
    assert installed() == [LOCKS["1.51"]]
    assert checkout("setup.sh").returncode == 0
    assert installed() == []


@pytest.mark.parametrize(
    ("drake", "python", "says"),
    [
        ("1.58", "3.11", "is Python 3.11, expected 3.12 to 3.14 (for Drake 1.58)"),
        ("1.58", "3.15", "is Python 3.15, expected 3.12 to 3.14"),
        ("1.57", "3.12", "MAKEBREAK_DRAKE is 1.57, expected 1.51 or 1.58"),
    ],
)
def test_drake_that_cannot_be_installed_is_refused(checkout, drake, python, says):
    done = checkout("setup.sh", MAKEBREAK_DRAKE=drake, STAND_IN_VERSION=python)
    assert done.returncode == 4
    assert says in done.stderr
    assert checkout.calls() == []


def pins(name, python="3.12"):
    """{package: version} of a lock file for a version of Python."""
    found = {}
    for line in (ROOT / name).read_text().splitlines():
        pin, _, marker = line.partition(";")
        environment = {"python_full_version": f"{python}.0", "python_version": python}
        if not pin.strip() or pin.startswith("#"):
            continue
        if not marker or Marker(marker).evaluate(environment):
            package, _, version = pin.strip().partition("==")
            found[package] = version
    return found


@pytest.mark.parametrize(
    ("drake", "python"),
    [("1.51", "3.10"), ("1.51", "3.11"), ("1.51", "3.14"), ("1.58", "3.12")],
)
def test_pins_are_within_the_ranges_of_the_package(drake, python):
    """What is tested must be what an installation from the ranges may get."""
    pinned = pins(LOCKS[drake], python)
    text = (ROOT / "pyproject.toml").read_text()
    lists = re.findall(r"^(?:dependencies|dev) = \[\n(.*?)^\]", text, re.M | re.S)
    asked = [
        Requirement(each) for each in re.findall(r'^ +"(.*)",', "".join(lists), re.M)
    ]
    assert {"drake", "pytest"} < {each.name for each in asked}
    for each in asked:
        if each.marker is None or each.marker.evaluate({"python_version": python}):
            assert pinned[canonicalize_name(each.name)] in each.specifier, str(each)


def test_lock_files_differ_in_drake_alone():
    """On Python 3.12, which both are for; so that a difference between two
    environments can only come from Drake."""
    old, new = pins(LOCKS["1.51"]), pins(LOCKS["1.58"])
    assert (old.pop("drake"), new.pop("drake")) == ("1.51.1", "1.58.0")
    assert old == new


APT_GET = r"""#!/bin/bash
[[ " $* " != *" install "* ]] || echo "$@" >>"$STAND_IN_DIR/apt.txt"
[[ ! -e "$STAND_IN_DIR/offline" ]] || exit 100
[[ " $* " != *" install "* ]] || rm -f "$STAND_IN_DIR/missing"
"""


def plant_apt(checkout, missing, packages):
    """Stand-ins for apt-get, for apt-cache that knows `packages`, and for a sudo that
    needs no password; `missing` is what Python finds missing until apt-get installs."""
    show = f'[[ " {packages} " == *" $2 "* ]]'
    sudo = '[[ "$1" != -n ]] || shift; "$@"'
    for name, text in {"apt-get": APT_GET, "apt-cache": show, "sudo": sudo}.items():
        text = text if text.startswith("#!") else f"#!/bin/bash\n{text}\n"
        (checkout.tools / name).write_text(text)
        (checkout.tools / name).chmod(0o755)
    (checkout.tools / "missing").write_text("\n".join(missing) + "\n")
    return f"{checkout.tools}:{os.environ['PATH']}"


@pytest.mark.parametrize(
    ("packages", "expected"),
    [
        ("", "python3-venv libx11-6 libglib2.0-0 libegl1"),
        (
            "python3.12-venv libglib2.0-0t64",
            "python3.12-venv libx11-6 libglib2.0-0t64 libegl1",
        ),
    ],
)
def test_missing_packages_are_installed_by_the_names_of_the_release(
    checkout, packages, expected
):
    missing = ["venv", "libX11.so.6", "libglib-2.0.so.0", "libEGL.so.1"]
    path = plant_apt(checkout, missing, packages)
    done = checkout("setup.sh", PATH=path)
    assert done.returncode == 0, done.stderr
    asked = (checkout.tools / "apt.txt").read_text()
    assert asked == f"-qq install -y --no-install-recommends {expected}\n"


def test_required_package_that_cannot_be_installed_ends_the_set_up(checkout):
    path = plant_apt(checkout, ["libSM.so.6", "swrast_dri.so"], "")
    (checkout.tools / "offline").touch()
    done = checkout("setup.sh", PATH=path)
    assert done.returncode == 4
    assert "could not install libsm6 (no network?)" in done.stderr.splitlines()[-1]
    assert checkout.calls() == []


def test_missing_opengl_is_said_and_does_not_end_the_set_up(checkout):
    path = plant_apt(checkout, ["swrast_dri.so"], "")
    (checkout.tools / "offline").touch()
    done = checkout("setup.sh", PATH=path)
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "OpenCV draws" in line]
    assert line.endswith("--no-install-recommends libgl1-mesa-dri)")


@pytest.mark.skipif(os.geteuid() == 0, reason="root installs what is missing")
def test_without_rights_one_command_is_named(checkout):
    path = plant_apt(checkout, ["venv", "libSM.so.6"], "")
    (checkout.tools / "sudo").write_text("#!/bin/bash\nexit 1\n")
    done = checkout("setup.sh", PATH=path)
    (line,) = done.stderr.splitlines()
    assert done.returncode == 4
    assert line.endswith("install -y --no-install-recommends python3-venv libsm6")


@pytest.mark.parametrize(
    ("given", "passed"),
    [
        ([], ["run"]),
        (["--set", "a=b c"], ["run", "--set", "a=b c"]),
        (["cartpole_walls", "--seed", "3"], ["run", "cartpole_walls", "--seed", "3"]),
        (["--version"], ["--version"]),
        (["run", "ball_rolling"], ["run", "ball_rolling"]),
        *(([name, "x"], [name, "x"]) for name in _COMMANDS),
    ],
)
def test_run_passes_its_arguments_and_keeps_the_folder(checkout, given, passed):
    done = checkout("run.sh", *given)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [*passed, str(checkout.tools)]


def test_set_up_compiles_when_asked_and_only_then(checkout):
    for _ in range(2):  # At the first set-up, and when it is done already.
        done = checkout("setup.sh", "--compile")
        assert (done.returncode, done.stdout.splitlines()[:1]) == (0, ["compile"])
    assert checkout("setup.sh").stdout == ""
    done = checkout("setup.sh", "--compil")
    assert done.returncode == 2 and "got --compil, expected --compile" in done.stderr


def test_test_script_runs_pytest_in_the_checkout(checkout):
    done = checkout("test.sh", "-k", "a or b")
    assert done.stdout.splitlines() == ["-k", "a or b", str(checkout.folder)]
    cores = len(os.sched_getaffinity(0))  # OMP_NUM_THREADS does not bind it.
    done = checkout("test.sh", OMP_NUM_THREADS="1")
    assert done.stdout.splitlines()[:2] == ["-n", str(cores)]
