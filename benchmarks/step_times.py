"""Times of tracking steps and of mapping iterations; on a GPU recorded and not, float32 and TF32.

    python benchmarks/step_times.py PART [full]

PART is steps, mapping or kernels; a CSV of that name is written into the folder $OUT. Networks of
full size are untrained, and images show noise on a wall, since a step takes the same time whatever
they contain. On a CPU all sizes are small, which only tests the script. With `full` they are not,
which takes minutes.
"""

import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from nbtrack import TRACKERS, Tracker, make_tracker
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import NetworkSettings, field_class, make_field
from nbtrack.machinery.device import choose_device, device_name, synchronize
from nbtrack.mapping.fit import _Fit
from nbtrack.tables import write_csv
from nbtrack.tracking import StepBudget

DEVICE = choose_device()
IS_GPU = DEVICE.type == "cuda"
IS_FULL = IS_GPU or "full" in sys.argv
WIDTH, HEIGHT = (640, 480) if IS_FULL else (64, 48)
N_TIMED, N_WARM = (200, 30) if IS_GPU else (10, 2)
N_PROFILED = 20
PAIRS = ("sdf", "neus"), ("vr", "imap")
NETWORK = NetworkSettings() if IS_FULL else NetworkSettings(width=32)
BOUNDS = SceneBounds((-3.0, -3.0, -1.0), (3.0, 3.0, 3.0))
PRECISIONS = {"float32": "highest", "TF32": "high"} if IS_GPU else {"float32": "highest"}


def noise(n_frames: int) -> RgbdSequence:
    """Frames of cameras that stand still about 2 m before a wall, with random colours."""
    rng, size = np.random.default_rng(0), (n_frames, HEIGHT, WIDTH)
    colors = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
    depths_mm = rng.integers(1950, 2050, size).astype(np.uint16)
    poses = np.tile(np.eye(4), (n_frames, 1, 1))
    camera, ids = Intrinsics.from_focal(WIDTH, HEIGHT, float(HEIGHT)), np.arange(n_frames)
    return RgbdSequence("wall", camera, colors, depths_mm, poses, ids, times=ids / 30)


SEQUENCE = noise(20)


def warm_tracker(name: str, field_name: str) -> Tracker:
    """A tracker at the start of its second frame, after all that takes time only in the first."""
    field = make_field(field_name, NETWORK, BOUNDS, seed=0).to(DEVICE)
    settings = TRACKERS[name].Settings(tf32=torch.get_float32_matmul_precision() == "high")
    settings = settings if IS_FULL else replace(settings, n_pixels=32)
    tracker = make_tracker(name, field, np.eye(4), StepBudget(1), settings)
    tracker.track(SEQUENCE[0])
    tracker.begin(SEQUENCE[1].to(DEVICE), torch.eye(4, device=DEVICE)[None])
    return tracker


def warm_fit(name: str, share: float | None = None) -> _Fit:
    """The fit of a map after its first iterations; `share` replaces NeuS's `eikonal_share`."""
    field = make_field(name, NETWORK, BOUNDS, seed=0).to(DEVICE)
    settings = field_class(name).Settings()
    if share is not None:
        settings = replace(settings, eikonal_share=float(share))
    settings = settings if IS_FULL else replace(settings, n_rays=16)
    fit = _Fit({"seed": 0}, settings, field, SEQUENCE, np.arange(len(SEQUENCE)))
    fit._advance(range(N_WARM))
    return fit


def milliseconds(call: Callable[[], object], waits: bool) -> tuple[float, float, float]:
    """Median and quartiles of a call's time. If `waits`, the device finishes before the next call.

    Otherwise calls are queued, and all three numbers are the mean.
    """
    for _ in range(N_WARM):
        call()
    synchronize(DEVICE)
    times = [time.perf_counter()]
    for _ in range(N_TIMED):
        call()
        if waits:
            synchronize(DEVICE)
            times.append(time.perf_counter())
    synchronize(DEVICE)
    if not waits:
        return (1e3 * (time.perf_counter() - times[0]) / N_TIMED,) * 3
    median, low, high = 1e3 * np.quantile(np.diff(times), [0.5, 0.25, 0.75])
    return median, low, high


def step_rows() -> Iterator[dict]:
    """Step times of the paper's trackers in its fields."""
    for name, field_name in PAIRS:
        tracker = warm_tracker(name, field_name)
        is_recordable = tracker.recording.is_recordable
        for is_recorded, waits in product({is_recordable, False}, (True, False)):
            tracker.recording.is_recordable = is_recorded
            median, low, high = milliseconds(tracker.step, waits)
            times = {"ms": median, "ms_low": low, "ms_high": high}
            yield {"tracker": name, "recorded": is_recorded, "waits": waits, **times}


def mapping_rows() -> Iterator[dict]:
    """Times of a mapping iteration after a warm-up; two iterations of each fit in turn.

    NeuS is measured with the eikonal term on its usual share of the samples, on one and on all.
    """
    shares = ("imap", None), ("neus", 0), ("neus", None), ("neus", 1), ("neus_plus", None)
    fits = {}
    for (name, share), is_recorded in product(shares, {IS_GPU, False}):
        fit = warm_fit(name, share)
        fit.recording.is_recordable &= is_recorded
        shown = getattr(fit.settings, "eikonal_share", None)
        fits[name, fit.settings.n_rays, shown, fit.recording.is_recordable] = fit
    seconds = dict.fromkeys(fits, 0.0)
    for first, (key, fit) in product(range(0, N_TIMED, 2), fits.items()):
        synchronize(DEVICE)
        start = time.perf_counter()
        fit._advance(range(first, first + 2))
        synchronize(DEVICE)
        seconds[key] += time.perf_counter() - start
    for (name, n_rays, share, is_recorded), total in seconds.items():
        what = {"field": name, "n_rays": n_rays, "eikonal_share": share, "recorded": is_recorded}
        yield what | {"ms": 1e3 * total / N_TIMED}


def kernel_rows() -> Iterator[dict]:
    """The ten slowest kernels of a step or an iteration, the sum of all, and the gaps between."""
    activity = torch.profiler.ProfilerActivity.CUDA if IS_GPU else None
    calls = {name: warm_tracker(name, field).step for name, field in PAIRS}
    for name in ("imap", "neus"):
        fit = warm_fit(name)
        calls[name] = partial(fit.recording.run, fit._descend)
    for name, call in calls.items():
        call()
        synchronize(DEVICE)
        with torch.profiler.profile(activities=[activity] if IS_GPU else None) as profile:
            start = time.perf_counter()
            for _ in range(N_PROFILED):
                call()
            synchronize(DEVICE)
            us = 1e6 * (time.perf_counter() - start)
        rows = [
            (event.key, event.count, event.self_device_time_total if IS_GPU else 0.0)
            for event in profile.key_averages()
        ]
        rows.sort(key=lambda row: -row[2])
        busy = sum(row[2] for row in rows)
        rows = [("all", sum(row[1] for row in rows), busy), ("gaps", 0, us - busy), *rows[:10]]
        for kernel, count, total in rows:
            of_one = {"count": count / N_PROFILED, "us": total / N_PROFILED}
            yield {"of": name, "kernel": kernel[:120], **of_one}


PARTS = {"steps": step_rows, "mapping": mapping_rows, "kernels": kernel_rows}


def main(part: str) -> None:
    """Measure one part at each precision, and write the CSV after each row."""
    torch.set_num_threads(1)
    found, out = [], Path(os.environ.get("OUT", "runs/first_gpu_run"))
    about = {"device": device_name(DEVICE), "torch": torch.__version__}
    for precision, word in PRECISIONS.items():
        torch.set_float32_matmul_precision(word)
        for row in PARTS[part]():
            found.append({**row, "precision": precision, **about})
            print(found[-1], flush=True)
            write_csv(out / f"{part}.csv", pd.DataFrame(found))


if __name__ == "__main__":
    main(sys.argv[1])
