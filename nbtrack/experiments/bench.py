"""Table II on the machine at hand: optimisation steps that fit in a time budget, and their time."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
import torch

from nbtrack.core.device import (
    advise_on_memory,
    choose_device,
    device_name,
    suitable_threads,
    synchronize,
)
from nbtrack.core.files import (
    fingerprint,
    foreign_source,
    runs_folder,
    sources_fingerprint,
    versions,
    write_atomic,
)
from nbtrack.core.progress import ProgressBar
from nbtrack.core.settings import as_dict
from nbtrack.data.sequence import RgbdSequence, observed_bounds
from nbtrack.experiments.methods import TABLE_1, Method, find_methods, tracker_label
from nbtrack.experiments.presets import Preset
from nbtrack.fields import make_field
from nbtrack.tracking import StepBudget, Tracker, make_budget, make_tracker, tracker_class

_LEAST_STEPS, _MOST_STEPS, _SECONDS_A_ROW = 5, 200, 4.0


def measure_steps(
    preset: Preset,
    sequence: RgbdSequence,
    methods: Sequence[str | Method] = TABLE_1,
    frames_per_cell: int = 3,
) -> pd.DataFrame:
    """Steps within each budget for every method's tracker and its pixel counts n.

    The fields are untrained: a step costs the same whatever the weights are. Each tracker first
    spends one frame that is not counted, so that allocations and compilations are done.

    Args:
        sequence: its first frame feeds the trackers.
        frames_per_cell: frames that a cell's mean is taken over.

    Returns:
        One row a cell: tracker ("VR", "SDF", ...), n_pixels, budget_ms, steps (mean over frames),
        steps_deviation (over frames).

    Source: paper, Table II and evaluation protocol.
    """
    rows, frame = [], sequence[0]
    for method, n_pixels in _rows(preset, methods, "Table II"):
        for budget_ms in preset.tables.budgets_ms:
            tracker = _tracker(preset, sequence, method, n_pixels, budget_ms)
            counts = []
            for _ in range(frames_per_cell + 1):
                tracker.restart(sequence.T_world_camera[0])
                counts.append(tracker.track(frame).steps)
            steps = np.array(counts[1:], dtype=float)
            place = (tracker_label(method.tracker), n_pixels, budget_ms)
            rows.append((*place, float(steps.mean()), float(steps.std())))
    columns = ["tracker", "n_pixels", "budget_ms", "steps", "steps_deviation"]
    return pd.DataFrame(rows, columns=columns)


def measured_steps(
    preset: Preset, sequence: RgbdSequence, methods: Sequence[str | Method] = TABLE_1
) -> pd.DataFrame:
    """Table II of this device as it was measured last, or measured now; see `measure_steps`."""
    camera = sequence.intrinsics
    trackers = [tracker_class(method.tracker) for method in find_methods(methods)]
    key = fingerprint(
        sources_fingerprint("fields", "tracking"), [foreign_source(t) for t in trackers],
        [t.name for t in trackers], device_name(choose_device()), torch.get_num_threads(),
        versions(), [as_dict(preset)[part] for part in ("network", "tracking", "tables")],
        [camera.width, camera.height],
    )  # fmt: skip
    path = runs_folder() / "bench" / f"{preset.name}-{key}.csv"
    if not path.is_file():
        cells = measure_steps(preset, sequence, methods)
        write_atomic(path, cells.to_csv(index=False))
    return pd.read_csv(path)


def default_pixels(preset: Preset, methods: Sequence[str | Method] = TABLE_1) -> dict[str, int]:
    """The n that each tracker uses for Table I, by its label in Table II."""
    trackers = [method.tracker for method in find_methods(methods)]
    return {tracker_label(name): preset.tracking_of(name).n_pixels for name in trackers}


def measure_step_times(
    preset: Preset, sequence: RgbdSequence, methods: Sequence[str | Method] = TABLE_1
) -> pd.DataFrame:
    """Time of a step for every method's tracker and its pixel counts n.

    Returns:
        A row each: tracker, n_pixels, ms_per_step (median), ms_low and ms_high (quartiles).
    """
    rows, device = [], choose_device()
    T_start = torch.from_numpy(sequence.T_world_camera[:1]).float().to(device)
    for method, n_pixels in _rows(preset, methods, "step times"):
        tracker = _tracker(preset, sequence, method, n_pixels)
        tracker.begin(sequence[0].to(device), T_start)
        tracker.step()
        seconds: list[float] = []
        while len(seconds) < _LEAST_STEPS or sum(seconds) < _SECONDS_A_ROW:
            synchronize(device)
            start = time.perf_counter()
            tracker.step()
            synchronize(device)
            seconds.append(time.perf_counter() - start)
            if len(seconds) == _MOST_STEPS:
                break
        low, median, high = 1e3 * np.quantile(seconds, [0.25, 0.5, 0.75])
        rows.append((tracker_label(method.tracker), n_pixels, median, low, high))
    columns = ["tracker", "n_pixels", "ms_per_step", "ms_low", "ms_high"]
    return pd.DataFrame(rows, columns=columns)


def _rows(
    preset: Preset, methods: Sequence[str | Method], title: str
) -> Iterator[tuple[Method, int]]:
    """Each method and pixel count in turn, under a bar, with suitable threads and advice."""
    plan = [(m, n) for m in find_methods(methods) for n in preset.tables.pixels_of(m.tracker)]
    with ProgressBar(title, len(plan)) as bar:
        for done, (method, n_pixels) in enumerate(plan):
            name = f"{method.tracker}={n_pixels}"
            bar.move_to(done, name)
            with (
                advise_on_memory(f"tables.pixels.{name}"),
                suitable_threads(preset.network_of(method.field).width),
            ):
                yield method, n_pixels
        bar.move_to(len(plan))


def _tracker(
    preset: Preset,
    sequence: RgbdSequence,
    method: Method,
    n_pixels: int,
    budget_ms: float | None = None,
) -> Tracker:
    """A tracker in an untrained field, which costs a step as much as a trained one."""
    device = choose_device()
    network = preset.network_of(method.field)
    field = make_field(method.field, network, observed_bounds(sequence), seed=0).to(device)
    budget = StepBudget(1)
    if budget_ms is not None:
        budget = make_budget(None, 1000 / budget_ms)
    settings = replace(preset.tracking_of(method.tracker), n_pixels=n_pixels)
    return make_tracker(method.tracker, field, sequence.T_world_camera[0], budget, settings)
