"""For all tests: one thread, no window, nothing that depends on the clock."""

import os
import signal

# Before numpy is imported: one thread per test process, and no matplotlib window.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

# A shell starts background jobs with SIGINT ignored, and a program inherits that: the
# tests that press Ctrl-C would press it in vain.
signal.signal(signal.SIGINT, signal.default_int_handler)
# And `nohup` one with SIGHUP ignored, which makebreak would then ignore as well.
signal.signal(signal.SIGHUP, signal.SIG_DFL)

from hypothesis import settings  # noqa: E402  (numpy's threads must be set first)

# The same examples in each run, and no deadline: a slow machine is no failure.
settings.register_profile("makebreak", derandomize=True, deadline=None)
settings.load_profile("makebreak")
