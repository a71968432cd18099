#!/usr/bin/env bash
# Table I at the paper's sizes, in five of its rooms, on one GPU, within ten minutes:
# `NBTRACK_DATA=ROOMS bash benchmarks/paper_rooms_gpu.sh [SECONDS]`. Rooms may still be on their way:
# one is taken up when its focal.txt is there. Maps and runs are cached in `NBTRACK_RUNS`; what is
# done after so many seconds goes into paper_tables/paper_rooms_gpu/, a room at a time.
set -u
cd "$(dirname -- "${BASH_SOURCE[0]}")/.."
export PYTHONPATH=$PWD/benchmarks:$PWD${PYTHONPATH:+:$PYTHONPATH} OMP_NUM_THREADS=1
side_by_side=12

one() { # room, method, rate: one run, after the map that it needs
  while [ ! -f "$NBTRACK_DATA/$1/focal.txt" ]; do sleep 1; done
  python3 - "$@" <<'PYTHON' && echo "$(date +%T) done: $*"
import sys
from evidence import PAPER_SIZES, track

from nbtrack import open_scene
room, method, rate = sys.argv[1:]
track([open_scene(room, PAPER_SIZES)], [method], PAPER_SIZES, rates_hz=[float(rate)], seeds=[0])
PYTHON
}
export -f one

for room in staircase whiteroom grey_white_room kitchen breakfast_room; do
  for run in "vr 2" "sdf 2" "vr 5" "sdf 5" "vr 10" "sdf 10"; do echo "$room $run"; done
done | timeout "${1:-480}" xargs -P $side_by_side -L 1 bash -c 'one "$@"' _
timeout 60 python3 benchmarks/evidence.py paper_rooms_gpu 1
