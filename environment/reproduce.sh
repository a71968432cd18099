#!/usr/bin/env bash
# Runs the notebooks and leaves both tables. Set-up included; any arguments go on to
# `python -m nbtrack notebooks`, for example --preset synthetic.
set -euo pipefail
source "$(dirname -- "${BASH_SOURCE[0]}")/common.sh"

started=$(mktemp)
trap 'rm -f "$started"' EXIT

"$venv_python" -m nbtrack notebooks --preset smoke "$@"

runs=${NBTRACK_RUNS:-$project_root/runs}
printf '\nTables:\n'
find "$runs/tables" -type f -newer "$started" | sort
printf 'Notebooks as they ran:\n'
find "$runs" -type f -name '*.html' -newer "$started" | sort
printf 'Everything took %d min %d s.\n' "$((SECONDS / 60))" "$((SECONDS % 60))"
