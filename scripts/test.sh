#!/usr/bin/env bash
# Runs the tests, after setting up what is missing. Arguments go to pytest, run in the
# project's folder; without any, the default suite runs on all cores.
set -euo pipefail

here="$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")"
"$here/setup.sh"

cd "$here/.."
unset PYTHONPATH PYTHONHOME   # As in setup.sh.
unset PYTHONDONTWRITEBYTECODE # Or each of the tests' processes reads all sources.
if [[ $# -eq 0 ]]; then
    # nproc would report OMP_NUM_THREADS, if that is set.
    set -- -n "$(env -u OMP_NUM_THREADS nproc)" --dist loadfile
fi
export OMP_NUM_THREADS=1 # One thread for each test process.
exec .venv/bin/python -m pytest "$@"
