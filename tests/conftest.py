"""Settings of all tests: one thread, no windows, no deadlines."""

import os
import signal

# Before numpy is imported: one thread per test process, and no matplotlib window.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

# Background jobs of a shell inherit an ignored SIGINT, with which the tests of Ctrl-C
# would fail.
signal.signal(signal.SIGINT, signal.default_int_handler)
# `nohup` makes programs ignore SIGHUP, which makebreak would then ignore, too.
signal.signal(signal.SIGHUP, signal.SIG_DFL)

from hypothesis import settings  # noqa: E402  (numpy's threads must be set first)

# The same examples in each run, and no deadline, so that slow machines do not fail.
settings.register_profile("makebreak", derandomize=True, deadline=None)
settings.load_profile("makebreak")
