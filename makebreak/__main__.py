"""`python -m makebreak` is the `makebreak` command."""

import sys

from makebreak.scripts.cli import main

if __name__ == "__main__":
    sys.exit(main())
