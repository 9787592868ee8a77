#!/usr/bin/env bash
# `scripts/run.sh ARGS` is `makebreak run ARGS`, after setting up what is missing.
# Without arguments: the main job, ball_rolling. Other commands pass as they are:
# `scripts/run.sh list`, `scripts/run.sh bench`, ...
set -euo pipefail

here="$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")"
"$here/setup.sh"

case "${1:-}" in
    list | run | station | reproduce | sweep | gap | convert | judge | design-log | \
        inspect | close-the-loop | export-tests | compile | bench | completion) ;;
    --version | --help | -h) ;;
    *) set -- run "$@" ;;
esac
unset PYTHONPATH PYTHONHOME # As in setup.sh.
exec "$here/../.venv/bin/makebreak" "$@"
