"""Table II on the machine at hand: optimisation steps that fit in a time budget."""

from dataclasses import replace

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from nbtrack.core.config import FieldConfig, Preset, as_dict
from nbtrack.core.device import advise_on_memory, device_name, suitable_threads, synchronize
from nbtrack.core.device_lock import alone_on
from nbtrack.core.files import write_text_atomic
from nbtrack.core.paths import runs_folder
from nbtrack.core.provenance import code_fingerprint, fingerprint, versions
from nbtrack.data.pixels import PixelSampler
from nbtrack.data.sequence import RgbdSequence, observed_bounds
from nbtrack.fields import make_field
from nbtrack.tables.layout import COLUMNS_2
from nbtrack.tracking.budget import ClockBudget
from nbtrack.tracking.trackers import TRACKERS, Tracker, paper_trackers

ENGINE_LABELS = {"plain": "", "fast": ", engine"}
"""What follows a tracker's name in Table II: the paper's trackers are in plain torch."""


def measure_steps(
    preset: Preset,
    sequence: RgbdSequence,
    device: torch.device,
    frames_per_cell: int = 3,
    progress: bool = True,
    engines: tuple[str, ...] = tuple(ENGINE_LABELS),
) -> pd.DataFrame:
    """Steps within each budget for every tracker, its pixel counts n, and both engines.

    The fields are untrained: a step costs the same whatever the weights are. Each tracker first
    spends one frame that is not counted, so that allocations and compilations are done.

    Args:
        sequence: its first frame feeds the trackers.
        frames_per_cell: frames that a cell's mean is taken over.

    Returns:
        One row a cell: tracker ("VR", "SDF", ... in plain torch, as the paper's; "VR, engine" and
        so on), n_pixels, budget_ms, steps (mean over frames), steps_deviation (over frames).

    Source: paper, Table II and evaluation protocol.
    """
    T_start = torch.from_numpy(sequence.T_world_camera[0]).float().to(device)
    make_tracker = TrackerMaker(preset, sequence, device)
    cells = [
        (name, engine, n_pixels, budget_ms)
        for engine in engines
        for name in paper_trackers()
        for n_pixels in preset.tables.pixels_of(name)
        for budget_ms in preset.tables.budgets_ms
    ]
    rows = []
    for name, engine, n_pixels, budget_ms in tqdm(
        cells, "Table II", unit="cell", disable=not progress
    ):
        with (
            advise_on_memory(f"tables.pixels.{name}={n_pixels}"),
            suitable_threads(network_of(preset, name).width),
            alone_on(device, tqdm.write),
        ):
            tracker = make_tracker(name, n_pixels, engine)
            steps = _count_steps(tracker, T_start, budget_ms, frames_per_cell, device)
        mean, deviation = float(steps.mean()), float(steps.std())
        rows.append((row_label(name, engine), n_pixels, budget_ms, mean, deviation))
    return pd.DataFrame(rows, columns=[*COLUMNS_2, "steps_deviation"])


def obtain_steps(
    preset: Preset, sequence: RgbdSequence, device: torch.device, measure_again: bool = False
) -> pd.DataFrame:
    """Table II of this device as it was measured last, or measured now; see `measure_steps`.

    Args:
        measure_again: measure although there is a measurement of the same code and settings.
    """
    trackers = [TRACKERS[name] for name in paper_trackers()]
    intrinsics = sequence.intrinsics
    key = fingerprint(
        code_fingerprint(measure_steps, *trackers), device_name(device), torch.get_num_threads(),
        versions(), [as_dict(preset)[part] for part in ("network", "tracking", "tables")],
        [intrinsics.width, intrinsics.height],
    )  # fmt: skip
    path = runs_folder() / "bench" / f"{preset.name}-{key}.csv"
    if measure_again or not path.is_file():
        cells = measure_steps(preset, sequence, device)
        write_text_atomic(path, cells.to_csv(index=False))
    return pd.read_csv(path)


def default_pixels(preset: Preset) -> dict[str, int]:
    """The n that each tracker of Table II uses for Table I, by its label."""
    return {
        row_label(name, engine): preset.tracking_of(name).n_pixels
        for name in paper_trackers()
        for engine in ENGINE_LABELS
    }


class TrackerMaker:
    """Makes trackers in untrained fields, which cost a step as much as trained ones."""

    def __init__(self, preset: Preset, sequence: RgbdSequence, device: torch.device) -> None:
        self.preset, self.device = preset, device
        self.sampler = PixelSampler(sequence, device)
        self.bounds = observed_bounds(sequence)

    def __call__(self, name: str, n_pixels: int, engine: str) -> Tracker:
        """A tracker by name, with n pixels a step, on an engine."""
        network = network_of(self.preset, name)
        field = make_field(TRACKERS[name].field_name, network, self.bounds, seed=0)
        field.to(self.device).eval().requires_grad_(False)
        config = replace(self.preset.tracking_of(name), n_pixels=n_pixels, engine=engine)
        generator = torch.Generator(self.device).manual_seed(0)
        return TRACKERS[name](field, self.sampler, config, generator)


def row_label(tracker_name: str, engine: str) -> str:
    """A tracker's name in Table II: the paper's, and a further one on the engine."""
    return TRACKERS[tracker_name].short_label + ENGINE_LABELS[engine]


def network_of(preset: Preset, tracker_name: str) -> FieldConfig:
    """Network of the field that a tracker works in."""
    return preset.network_of(TRACKERS[tracker_name].field_name)


def _count_steps(
    tracker: Tracker,
    T_start: Float[Tensor, "4 4"],
    budget_ms: float,
    n_frames: int,
    device: torch.device,
) -> Float[np.ndarray, "frames"]:
    """Steps of each counted frame; the same image serves all of them."""
    budget = ClockBudget(1000 / budget_ms, synchronize=lambda: synchronize(device))
    counts = []
    for _ in range(n_frames + 1):
        tracker.start_frame(0, T_start[None])
        steps = 0
        for _ in budget.frame():
            tracker.step()
            steps += 1
        counts.append(steps)
    return np.array(counts[1:], dtype=float)
