#!/usr/bin/env bash
# Style, unit tests, and all notebooks recomputed and compared with their stored outputs.
set -euo pipefail
source "$(dirname -- "${BASH_SOURCE[0]}")/common.sh"
cd "$project_root"

# An empty cache, so that every output is computed anew, and no settings of the caller's own:
# stored outputs are those of the defaults.
NBTRACK_RUNS=$(mktemp -d)
trap 'rm -rf "$NBTRACK_RUNS"' EXIT
export NBTRACK_RUNS
unset NBTRACK_PRESET NBTRACK_CONFIG NBTRACK_SET NBTRACK_DATA

step "Style" "$venv_python" -m ruff check
step "Formatting" "$venv_python" -m ruff format --check --quiet
# One process a core; the longest modules begin (tests/conftest.py). Without the notebooks' plugin,
# which takes seconds to load in each process.
step "Unit tests" "$venv_python" -m pytest -q -p no:nbval -n auto --dist loadfile \
    --no-loadscope-reorder
# Two at a time: parts of each keep one core busy. What one needs of another, it waits for or makes.
step "Notebooks against their stored outputs" "$venv_python" -m pytest --nbval notebooks \
    -q -n 2 --dist loadfile --no-loadscope-reorder
printf 'All checks passed in %d min %d s.\n' "$((SECONDS / 60))" "$((SECONDS % 60))"
