#!/usr/bin/env bash
# A first run on a machine with an NVIDIA GPU, twelve minutes at most: `bash benchmarks/first_gpu_run.sh`.
# Takes the python3 of the PATH and whatever it has, writes CSV files and a log into $OUT. Each part
# fails alone. Without a GPU it runs through in small, which says that the script is sound.
set -u
cd "$(dirname -- "${BASH_SOURCE[0]}")/.."
OUT=${OUT:-runs/first_gpu_run}
mkdir -p "$OUT"
OUT=$(cd "$OUT" && pwd)
exec > >(tee "$OUT/log.txt") 2>&1
export OUT PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} NBTRACK_RUNS=$OUT/cache PYTHONUNBUFFERED=1
echo "results in $OUT"

python3 - <<'PYTHON' || exit 1
import importlib.util as find, platform, sys
needed = {
    "everything": "torch numpy scipy pandas jaxtyping tqdm safetensors numba",
    "the command line, and mapping": "filelock cv2 skimage trimesh matplotlib jinja2",
    "ICP": "small_gicp", "tests": "pytest",
}
print("Python", platform.python_version())
for part, names in needed.items():
    lacks = [name for name in names.split() if find.find_spec(name) is None]
    if lacks:
        print(f"!!! missing {', '.join(lacks)}: needed by {part}, which will fail")
if find.find_spec("torch") is None:
    sys.exit("nothing can be done without torch")
PYTHON
if python3 -c 'import torch, sys; print("torch", torch.__version__); sys.exit(not torch.cuda.is_available())'
then export NBTRACK_DEVICE=cuda; small=(); nvidia-smi -L
else export NBTRACK_DEVICE=cpu; echo "no GPU here: everything in small"
  small=(--set scenes.n_frames=6 --set scenes.width=64 --set network.neus.width=32
         --set network.imap.width=32 --set mapping.neus.iterations=20 --set mapping.imap.iterations=20
         --set 'tables.pixels.sdf=[64]' --set 'tables.pixels.vr=[16]' --set 'tables.budgets_ms=[50]')
fi

part() { # seconds that it may take, and a command
  local seconds=$1; shift
  echo "=== $(date +%T) $*"
  timeout "$seconds" "$@" || echo "!!! status $? of: $*"
}
part 110 python3 benchmarks/step_times.py steps
part 110 python3 benchmarks/step_times.py mapping
part 60 python3 benchmarks/step_times.py kernels
part 60 python3 -m pytest -q -p no:cacheprovider --noconftest -W default -m gpu \
  tests/test_launches.py tests/test_sampling.py
sizes=(--preset synthetic)
[ "$NBTRACK_DEVICE" = cpu ] && sizes=(--preset smoke "${small[@]}")
part 120 python3 -m nbtrack bench "${sizes[@]}" --out "$OUT/bench"
track() { # seconds, its name, the options
  local seconds=$1 name=$2; shift 2
  part "$seconds" python3 -m nbtrack track living_room "$@" --preset smoke --frames :60 \
    ${small[@]+"${small[@]}"} --out "$OUT/track_$name"
}
track 70 sdf --field neus --tracker sdf --rate 30
track 40 vr --field imap --tracker vr --rate 10
track 40 lm --field neus --tracker lm --steps 20
track 60 corrected
track 40 icp --field points --tracker icp --steps 30
echo "=== $(date +%T) done: $OUT"
