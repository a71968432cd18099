"""Table II on the machine at hand: optimisation steps that fit in a time budget, and their time."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
import torch

from nbtrack.core.device import advise_on_memory, choose_device, suitable_threads, synchronize
from nbtrack.core.progress import ProgressBar
from nbtrack.data.sequence import RgbdSequence, observed_bounds
from nbtrack.experiments.methods import TABLE_1, Method, find_methods
from nbtrack.experiments.presets import Preset
from nbtrack.fields import make_field
from nbtrack.tracking import ClockBudget, StepBudget, Tracker, make_tracker

_FRAMES_A_CELL = 3  # that a mean of steps is taken over
_LEAST_STEPS, _MOST_STEPS, _SECONDS_A_ROW = 5, 200, 4.0  # that are timed


def measure_steps(
    preset: Preset, sequence: RgbdSequence, methods: Sequence[str | Method] = TABLE_1
) -> pd.DataFrame:
    """Steps within each budget for every tracker, in its first method's field, and its n (pixels).

    A tracker first spends one frame that is not counted, so that allocations and compilations are
    done. The sequence's first frame feeds it.

    Returns:
        One row a cell: tracker ("VR", "SDF", ...), n_pixels, budget_ms, steps (mean over frames),
        steps_deviation (over frames).

    Source: paper, Table II and evaluation protocol.
    """
    rows = []
    for name, n_pixels, tracker in _trackers(preset, sequence, methods, "Table II"):
        for budget_ms in preset.tables.budgets_ms:
            tracker.budget, counts = ClockBudget(1000 / budget_ms), []
            for _ in range(1 + _FRAMES_A_CELL):
                tracker.restart(sequence.T_world_camera[0])
                counts.append(tracker.track(sequence[0]).steps)
            mean, deviation = float(np.mean(counts[1:])), float(np.std(counts[1:]))
            rows.append((name, n_pixels, budget_ms, mean, deviation))
    columns = ["tracker", "n_pixels", "budget_ms", "steps", "steps_deviation"]
    return pd.DataFrame(rows, columns=columns)


def default_pixels(preset: Preset, methods: Sequence[str | Method] = TABLE_1) -> dict[str, int]:
    """The n that each tracker uses for Table I, by its label in Table II."""
    trackers = [method.tracker for method in find_methods(methods)]
    return {_label(name): preset.tracking_of(name).n_pixels for name in trackers}


def measure_step_times(preset: Preset, sequence: RgbdSequence) -> pd.DataFrame:
    """Time of a step of the paper's trackers with their pixel counts n.

    Returns:
        A row each: tracker, n_pixels, ms_per_step (median), ms_low and ms_high (quartiles).
    """
    rows, device = [], choose_device()
    T_start = torch.from_numpy(sequence.T_world_camera[:1]).float().to(device)
    for name, n_pixels, tracker in _trackers(preset, sequence, TABLE_1, "step times"):
        tracker.track(sequence[0])  # with what counts nowhere
        tracker.begin(sequence[0].to(device), T_start)
        synchronize(device)
        times = [time.perf_counter()]
        while len(times) <= _LEAST_STEPS or (
            len(times) <= _MOST_STEPS and times[-1] - times[0] < _SECONDS_A_ROW
        ):
            tracker.step()
            synchronize(device)
            times.append(time.perf_counter())
        low, median, high = 1e3 * np.quantile(np.diff(times), [0.25, 0.5, 0.75])
        rows.append((name, n_pixels, median, low, high))
    columns = ["tracker", "n_pixels", "ms_per_step", "ms_low", "ms_high"]
    return pd.DataFrame(rows, columns=columns)


def _trackers(
    preset: Preset, sequence: RgbdSequence, methods: Sequence[str | Method], title: str
) -> Iterator[tuple[str, int, Tracker]]:
    """Label, n and a tracker of each row in turn, under a bar, with suitable threads and advice.

    The fields are untrained: a step costs the same whatever the weights are.
    """
    firsts: dict[str, Method] = {}
    for method in find_methods(methods):
        firsts.setdefault(method.tracker, method)
    pixels = preset.tables.pixels
    plan = [(m, n) for m in firsts.values() for n in pixels.get(m.tracker, pixels["sdf"])]
    bounds, T_first = observed_bounds(sequence), sequence.T_world_camera[0]
    with ProgressBar(title, len(plan)) as bar:
        for done, (method, n_pixels) in enumerate(plan):
            tracker, network = method.tracker, preset.network_of(method.field)
            bar.move_to(done, f"{tracker}={n_pixels}")
            with (
                advise_on_memory(f"tables.pixels.{tracker}={n_pixels}"),
                suitable_threads(network.width),
            ):
                field = make_field(method.field, network, bounds, seed=0).to(choose_device())
                settings = replace(preset.tracking_of(tracker), n_pixels=n_pixels)
                made = make_tracker(tracker, field, T_first, StepBudget(1), settings)
                yield _label(tracker), n_pixels, made
        bar.move_to(len(plan))


def _label(tracker: str) -> str:
    """A tracker's name in Table II: VR for vr."""
    return tracker.upper().replace("_", " ")
