#!/usr/bin/env bash
# Runs the notebooks and leaves both tables. Set-up included. NBTRACK_PRESET, by default smoke, and
# NBTRACK_SET say with which settings.
set -euo pipefail
source "$(dirname -- "${BASH_SOURCE[0]}")/common.sh"

started=$(mktemp)
trap 'rm -f "$started"' EXIT

runs=${NBTRACK_RUNS:-$project_root/runs}
"$venv_python" "$project_root/environment/pages.py" --execute "$runs/pages"

printf '\nTables:\n'
find "$runs/tables" -type f -newer "$started" | sort
printf 'Notebooks as they ran: %s\n' "$runs/pages/index.html"
printf 'Everything took %d min %d s.\n' "$((SECONDS / 60))" "$((SECONDS % 60))"
