#!/usr/bin/env bash
# Runs the notebooks and leaves both tables. Set-up included. NBTRACK_PRESET, by default smoke, and
# NBTRACK_SET say with which settings.
set -euo pipefail
source "$(dirname -- "${BASH_SOURCE[0]}")/common.sh"

started=$(mktemp)
trap 'rm -f "$started"' EXIT

runs=${NBTRACK_RUNS:-$project_root/runs}
"$venv_python" -m nbconvert --execute --to html --output-dir "$runs/notebooks" \
    "$project_root"/notebooks/*.ipynb

printf '\nTables:\n'
find "$runs/tables" -type f -newer "$started" | sort
printf 'Notebooks as they ran:\n'
find "$runs" -type f -name '*.html' -newer "$started" | sort
printf 'Everything took %d min %d s.\n' "$((SECONDS / 60))" "$((SECONDS % 60))"
