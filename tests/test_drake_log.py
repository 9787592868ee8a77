"""What Drake logs comes once, alike messages with a count, physics as a check."""

import logging

from makebreak.scripts.cli.drake_log import DrakeLog

IGNORED = "is currently unsupported and will be ignored."


def test_alike_messages_are_one_line_with_a_count_and_come_afterwards(capsys):
    log = logging.getLogger("drake")
    with DrakeLog() as said:
        for _ in range(3):  # As often as the model is loaded.
            for line in range(1, 86):
                log.warning(f"arm.xml:{line}: warning: The attribute 'rgba' {IGNORED}")
            log.warning("arm.xml:3: warning: The tag 'sensor' %s", IGNORED)
        assert capsys.readouterr().err == ""
        log.info("Meshcat listening")
    first, second = said.lines()
    assert first.startswith("arm.xml:1: warning: The attribute 'rgba'")
    assert first.endswith("(and 84 alike)")
    assert "'sensor'" in second and "alike" not in second
    said.show()
    assert capsys.readouterr().err.count("\n") == 2


def test_what_changes_the_motion_is_a_check_and_no_line():
    log = logging.getLogger("drake")
    with DrakeLog() as said:
        for line in (4, 9):
            log.warning(f"a.xml:{line}: warning: 'frictionloss' of a joint {IGNORED}")
        # A file's name says nothing of the physics.
        log.warning(f"friction.xml:1: warning: The tag 'visual' {IGNORED}")
    assert len(said.lines()) == 1 and "visual" in said.lines()[0]
    [check] = said.findings("log")
    assert check.severity == "warning" and "frictionloss" in check.says
    assert check.says.endswith("(and 1 alike)")


def test_the_logger_is_as_it_was_afterwards_and_a_failure_shows_what_was_said(capsys):
    log = logging.getLogger("drake")
    before = log.handlers[:], log.propagate
    try:
        with DrakeLog():
            log.warning("the mesh has no volume")
            raise ValueError
    except ValueError:
        pass
    assert (log.handlers[:], log.propagate) == before
    assert capsys.readouterr().err == "Drake: the mesh has no volume\n"
