"""What bash completes, asked of bash."""

import shutil
import subprocess

import pytest

from makebreak.scripts.cli import commands as cli


def completed(script, *words):
    """What bash offers for the last of the words."""
    ask = f"""source {script}; COMP_WORDS=(makebreak {" ".join(words)})
    COMP_CWORD={len(words)}; _shtab_makebreak; printf '%s\\n' "${{COMPREPLY[@]}}" """
    done = subprocess.run(["bash", "-c", ask], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_bash_completes_commands_experiments_options_and_files(tmp_path, capsys):
    assert cli.main(["completion", "bash"]) == 0
    script = tmp_path / "makebreak.bash"
    script.write_text(capsys.readouterr().out)
    assert completed(script, "rep") == ["reproduce"]
    assert completed(script, "run", "ball_") == ["ball_rolling"]
    assert completed(script, "run", "ball_rolling", "--no-m") == ["--no-meshcat"]
    assert completed(script, "gap", str(script)[:-3]) == [str(script)]
    assert "zsh" in completed(script, "completion", "")


def test_an_unknown_shell_is_one_line(capsys):
    assert cli.main(["completion", "csh"]) == 2
    assert 'got "csh", expected one of bash, ' in capsys.readouterr().err
