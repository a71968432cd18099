"""How near a step comes to what the arithmetic alone would take, and how fast maps are made."""

import resource
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd
import torch
from tqdm import tqdm

from nbtrack.core.config import FieldConfig, Preset, TrackingConfig
from nbtrack.core.device import suitable_threads, synchronize
from nbtrack.core.device_lock import alone_on
from nbtrack.data.sequence import RgbdSequence
from nbtrack.experiments.bench import ENGINE_LABELS, TrackerMaker, network_of, row_label
from nbtrack.experiments.scenes import Scene
from nbtrack.mapping.fit import map_sequence, split_holdout
from nbtrack.mapping.quality import score_map
from nbtrack.tracking.trackers import TRACKERS, paper_trackers

_LEAST_STEPS, _MOST_STEPS, _SECONDS_A_ROW = 5, 200, 4.0
_PRODUCT_ROWS = 4096  # of the matrix product whose rate counts as the machine's
TARGET_M = 0.02  # near-surface error of the distance that mapping is timed to


def forward_flops(network: FieldConfig) -> int:
    """Floating-point operations of the network at one point: two for each weight.

    The derivative by position takes as many again, products only; sines and activations are not
    counted.
    """
    width, n_frequencies = network.width, network.n_frequencies
    weights = 3 * n_frequencies + n_frequencies * width + width**2
    weights += (width + n_frequencies) * width + width**2 + 4 * width
    return 2 * weights


def step_flops(tracker_name: str, config: TrackingConfig, network: FieldConfig) -> int:
    """Floating-point operations of the network in one step of a tracker.

    All samples of the last pass are differentiated; volume rendering's first pass is not.
    """
    evaluations = TRACKERS[tracker_name].evaluations_per_pixel(config)
    is_rendering = TRACKERS[tracker_name].renders
    differentiated = config.n_stratified + config.n_importance if is_rendering else evaluations
    return config.n_pixels * (evaluations + differentiated) * forward_flops(network)


def measure_step_times(
    preset: Preset, sequence: RgbdSequence, device: torch.device, progress: bool = True
) -> pd.DataFrame:
    """Time of a step for every tracker, its pixel counts n and both engines, side by side.

    Both engines and the matrix product that gives the floor take turns within a row, so that
    other work on the machine meets all three.

    Returns:
        A row each: tracker, n_pixels, ms_per_step (median), ms_low and ms_high (quartiles),
        floor_ms (operations over the rate of products, measured beside), times_floor.
    """
    maker = TrackerMaker(preset, sequence, device)
    T_start = torch.from_numpy(sequence.T_world_camera[:1]).float().to(device)
    cells = [(name, n) for name in paper_trackers() for n in preset.tables.pixels_of(name)]
    rows = []
    for name, n_pixels in tqdm(cells, "step times", unit="row", disable=not progress):
        network = network_of(preset, name)
        config = replace(preset.tracking_of(name), n_pixels=n_pixels)
        with suitable_threads(network.width), alone_on(device, tqdm.write):
            trackers = {engine: maker(name, n_pixels, engine) for engine in ENGINE_LABELS}
            for tracker in trackers.values():
                tracker.start_frame(0, T_start)
            steps = {engine: tracker.step for engine, tracker in trackers.items()}
            product, flops = _layer_product(network.width, device)
            seconds = _alternated({**steps, "product": product}, device)
        # The rate of the machine's matrix products, the median as for the steps.
        rate = flops / float(np.median(seconds.pop("product")))
        floor = step_flops(name, config, network) / rate
        for engine, times in seconds.items():
            low, median, high = np.quantile(times, [0.25, 0.5, 0.75])
            rows.append(
                {
                    "tracker": row_label(name, engine), "n_pixels": n_pixels,
                    "ms_per_step": 1e3 * median, "ms_low": 1e3 * low, "ms_high": 1e3 * high,
                    "floor_ms": 1e3 * floor, "times_floor": median / floor,
                }
            )  # fmt: skip
    return pd.DataFrame(rows)


def measure_mapping(preset: Preset, sequence: RgbdSequence, device: torch.device) -> pd.DataFrame:
    """Mapping iterations a second of the paper's two fields, and the ratio for equal samples.

    Returns:
        A row a field: field, n_rays, n_samples (a ray), iterations_per_second, us_per_sample.
    """
    rows = []
    for name in ("imap", "neus"):
        config = replace(preset.mapping_of(name), iterations=_MAPPING_ITERATIONS)
        with alone_on(device, tqdm.write):
            fitted = map_sequence(name, sequence, preset.network_of(name), config, device=device)
        rate = config.iterations / fitted.seconds
        n_samples = config.n_stratified + config.n_surface
        rows.append(
            {
                "field": name, "n_rays": config.n_rays, "n_samples": n_samples,
                "iterations_per_second": rate,
                "us_per_sample": 1e6 / (rate * config.n_rays * n_samples),
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


_MAPPING_ITERATIONS = 8
_SHARES = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)


def time_to_distance(
    preset: Preset, scene: Scene, device: torch.device, target_m: float = TARGET_M
) -> pd.DataFrame:
    """Seconds of mapping on one core until the distance near surfaces is right to some centimetres.

    Maps of growing numbers of iterations are made, each with the learning rates of a finished one,
    until one reaches the target; the best of it and those before counts.

    Returns:
        A row a map: field, iterations, seconds, near_m.
    """
    sequence = scene.read()
    mapped, held_out = split_holdout(len(sequence), preset.mapping_of("neus").holdout_every)
    rows = []
    for name in ("neus", "neus_plus"):
        whole = preset.mapping_of(name)
        for share in tqdm(_SHARES, f"time to {100 * target_m:g} cm, {name}", unit="map"):
            config = replace(whole, iterations=max(1, round(share * whole.iterations)))
            with alone_on(device, tqdm.write):
                fitted = map_sequence(
                    name, sequence, preset.network_of(name), config, device=device
                )
            quality = score_map(fitted.field, sequence, mapped, held_out, scene.room)
            rows.append((name, config.iterations, fitted.seconds, quality.sdf_near_m))
            if quality.sdf_near_m <= target_m:
                break
    return pd.DataFrame(rows, columns=["field", "iterations", "seconds", "near_m"])


def peak_memory_gb(device: torch.device) -> float:
    """The most memory that this process has held so far: the GPU's there, else the host's."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e9
    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, else kibibytes
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def _layer_product(width: int, device: torch.device) -> tuple[Callable[[], object], int]:
    """The product of a network's layer with many rows, and its floating-point operations."""
    rows, weights = (torch.rand(n, width, device=device) for n in (_PRODUCT_ROWS, width))
    out = torch.empty_like(rows)
    return lambda: torch.mm(rows, weights, out=out), 2 * _PRODUCT_ROWS * width**2


def _alternated(
    steps: dict[str, Callable[[], object]], device: torch.device
) -> dict[str, list[float]]:
    """Seconds of each call of several functions that take turns; first calls are not counted."""
    for step in steps.values():
        step()
    seconds: dict[str, list[float]] = {name: [] for name in steps}
    start = time.perf_counter()
    for turn in range(_MOST_STEPS):
        for name, step in steps.items():
            seconds[name].append(_seconds_of(step, device))
        if turn + 1 >= _LEAST_STEPS and time.perf_counter() - start > _SECONDS_A_ROW:
            break
    return seconds


def _seconds_of(call: Callable[[], object], device: torch.device) -> float:
    synchronize(device)
    start = time.perf_counter()
    call()
    synchronize(device)
    return time.perf_counter() - start
