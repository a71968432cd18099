"""Fit a field to posed RGB-D frames: one loop for every field, with checkpoints and resume."""

import io
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from jaxtyping import Int

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.config import FieldConfig, MappingConfig, as_dict
from nbtrack.core.device import advise_on_memory, suitable_threads
from nbtrack.core.errors import DataError, NumericalError
from nbtrack.core.files import naming_damaged, read_checkpoint, write_bytes_atomic
from nbtrack.data.pixels import PixelSampler
from nbtrack.data.sequence import RgbdSequence, observed_bounds
from nbtrack.fields import Field, LearnedField, field_class, make_field
from nbtrack.fields.sampling import draw_batch

CHECKPOINT_SECONDS = 10.0  # between two checkpoints: what a killed run loses at most
# Iterations between two looks at the losses: each look waits for the device, so there are ten
# where they are fast, and one where a user would wait for news.
_FLUSH_EVERY, _SLOW_SECONDS = 10, 0.2
_FINAL_RATE = 0.05  # learning rate at the end, relative to the start (NeuS)

OnIteration = Callable[[int, dict[str, float]], None]


@dataclass(frozen=True)
class FittedMap:
    """A mapped scene."""

    field: Field
    history: pd.DataFrame  # one row an iteration: weighted loss terms and diagnostics
    seconds: float  # time spent in iterations, before and after a resume together
    resumed_from: int = 0  # iteration at which this run took up a checkpoint


def split_holdout(
    n_frames: int, every: int
) -> tuple[Int[np.ndarray, "mapping"], Int[np.ndarray, "held_out"]]:
    """Indices of the frames to map and of those kept back for scoring.

    Every `every`-th frame is kept back, beginning in the middle of the first stretch; with
    `every` = 0, or too few frames, none is.

    >>> split_holdout(6, 3)
    (array([0, 2, 3, 5]), array([1, 4]))
    """
    indices = np.arange(n_frames)
    if every < 2 or n_frames < every:
        return indices, indices[:0]
    held_out = indices[every // 2 :: every]
    return np.setdiff1d(indices, held_out), held_out


def map_sequence(
    field_name: str,
    sequence: RgbdSequence,
    field_config: FieldConfig,
    config: MappingConfig,
    seed: int = 0,
    device: torch.device | None = None,
    checkpoint: Path | None = None,
    on_iteration: OnIteration | None = None,
) -> FittedMap:
    """Fit a field to a sequence with known poses; points, which learn nothing, are fused.

    Args:
        checkpoint: file that is written every few seconds and, where it exists and fits, resumed
            from. A resumed run draws the same batches as an uninterrupted one.
        on_iteration: called with the iteration count and its losses, a few times a second at most.

    Raises:
        DataError: no pixel has a depth, or the checkpoint belongs to other settings.
        NumericalError: a loss is not finite.
        OutOfMemory: the device holds too few rays at once.
    """
    device = device or torch.device("cpu")
    if not issubclass(field_class(field_name), LearnedField):
        settings = _settings(field_name, sequence, field_config, config, seed)
        return _fuse_sequence(
            sequence, field_config, config, settings, device, checkpoint, on_iteration
        )
    setting = f"mapping.{field_name}.n_rays={config.n_rays}"
    with advise_on_memory(setting), suitable_threads(field_config.width):
        run = _Run(field_name, sequence, field_config, config, seed, device)
        if checkpoint and checkpoint.exists():
            run.load(checkpoint)
        resumed_from = run.iteration
        last_saved = time.perf_counter()
        while run.iteration < config.iterations:
            run.advance(min(run.iterations_to_flush, config.iterations - run.iteration))
            if on_iteration:
                on_iteration(run.iteration, run.history[-1])
            if checkpoint and time.perf_counter() - last_saved > CHECKPOINT_SECONDS:
                run.save(checkpoint)
                last_saved = time.perf_counter()
        if checkpoint:
            run.save(checkpoint)
    run.field.eval().requires_grad_(False)
    return FittedMap(run.field, run.history_frame(), run.seconds, resumed_from)


def load_map(
    checkpoint: Path, field_name: str, field_config: FieldConfig, device: torch.device
) -> FittedMap:
    """A finished map from its last checkpoint, ready for tracking.

    Raises:
        DataError: the file is not a map of this field.
    """
    state = read_checkpoint(checkpoint)
    with naming_damaged(checkpoint):
        if state["settings"]["field"] != field_name:
            raise DataError(
                f"{checkpoint} is a map of field {state['settings']['field']!r}, not "
                f"{field_name!r}: map again or name the right field"
            )
        field = make_field(field_name, field_config, SceneBounds(*state["bounds"]), seed=0)
        field.load_state_dict(state["field"])
        field.to(device).eval().requires_grad_(False)
        columns = {name: values.numpy() for name, values in state["history"].items()}
        history = pd.DataFrame(columns).rename_axis("iteration")
        return FittedMap(field, history, state["seconds"], state["iteration"])


class _Run:
    """All that changes while a field is fitted, and nothing else."""

    def __init__(
        self,
        field_name: str,
        sequence: RgbdSequence,
        field_config: FieldConfig,
        config: MappingConfig,
        seed: int,
        device: torch.device,
    ) -> None:
        self.config = config
        self.settings = _settings(field_name, sequence, field_config, config, seed)
        self.bounds = observed_bounds(sequence)
        self.field = make_field(field_name, field_config, self.bounds, seed).to(device)
        self.optimizer = torch.optim.Adam(self.field.parameters(), lr=config.learning_rate)
        self.generator = torch.Generator(device).manual_seed(seed)
        self.sampler = PixelSampler(sequence, device)
        mapping_frames, _ = split_holdout(len(sequence), config.holdout_every)
        self.frames = torch.from_numpy(mapping_frames).to(device)
        self.field.prepare(sequence, mapping_frames)
        self.iteration = 0
        self.seconds = 0.0
        self.history: list[dict[str, float]] = []

    @property
    def iterations_to_flush(self) -> int:
        """How many iterations to take before the next look at their losses."""
        is_slow = self.seconds > _SLOW_SECONDS * max(self.iteration, 1)
        return 1 if is_slow or self.iteration == 0 else _FLUSH_EVERY

    def advance(self, n_iterations: int) -> None:
        """Take some steps, then look at their losses once."""
        start = time.perf_counter()
        pending = [self._step(self.iteration + offset) for offset in range(n_iterations)]
        names = list(pending[0])
        values = torch.stack([torch.stack(list(terms.values())) for terms in pending]).tolist()
        diagnostics = self.field.diagnostics()
        for offset, row in enumerate(values):
            terms = dict(zip(names, row, strict=True))
            for name, value in terms.items():
                if not math.isfinite(value):
                    raise NumericalError(
                        f"loss term {name!r} became {value} at mapping iteration "
                        f"{self.iteration + offset}: lower the learning rate "
                        f"({self.config.learning_rate:g}) or check the depth and poses"
                    )
            self.history.append({**terms, "total": sum(row), **diagnostics})
        self.iteration += n_iterations
        self.seconds += time.perf_counter() - start

    def _step(self, iteration: int) -> dict[str, torch.Tensor]:
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(self.config, iteration)
        batch = draw_batch(self.field, self.sampler, self.config, self.generator, self.frames)
        terms = self.field.mapping_losses(batch, self.config, self.generator)
        self.optimizer.zero_grad(set_to_none=True)
        torch.stack(list(terms.values())).sum().backward()
        self.optimizer.step()
        return {name: value.detach() for name, value in terms.items()}

    def history_frame(self) -> pd.DataFrame:
        return pd.DataFrame(self.history).rename_axis("iteration")

    def save(self, checkpoint: Path) -> None:
        fitted = FittedMap(self.field, self.history_frame(), self.seconds)
        _write_map(
            checkpoint, self.settings, fitted, self.iteration,
            optimizer=self.optimizer.state_dict(), generator=self.generator.get_state(),
        )  # fmt: skip

    def load(self, checkpoint: Path) -> None:
        state = _checked_state(checkpoint, self.settings)
        with naming_damaged(checkpoint):
            self.field.load_state_dict(state["field"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.generator.set_state(state["generator"])
            self.iteration, self.seconds = state["iteration"], state["seconds"]
            columns = {name: values.tolist() for name, values in state["history"].items()}
            self.history = pd.DataFrame(columns).to_dict("records")


def _fuse_sequence(
    sequence: RgbdSequence,
    field_config: FieldConfig,
    config: MappingConfig,
    settings: dict[str, Any],
    device: torch.device,
    checkpoint: Path | None,
    on_iteration: OnIteration | None,
) -> FittedMap:
    """The map of a field that is not fitted, but fused from the mapped frames all at once."""
    if checkpoint and checkpoint.exists():
        _checked_state(checkpoint, settings)
        return load_map(checkpoint, settings["field"], field_config, device)
    start = time.perf_counter()
    bounds = observed_bounds(sequence)
    field = make_field(settings["field"], field_config, bounds, settings["seed"])
    mapping_frames, _ = split_holdout(len(sequence), config.holdout_every)
    field.fuse(sequence, mapping_frames, config.voxel)
    field.to(device).eval().requires_grad_(False)
    row = {"points": float(len(field.points)), "bytes": float(field.n_bytes)}
    history = pd.DataFrame([row]).rename_axis("iteration")
    fitted = FittedMap(field, history, time.perf_counter() - start)
    if on_iteration:
        on_iteration(config.iterations, row)  # all that a progress bar waits for
    if checkpoint:
        _write_map(checkpoint, settings, fitted, iteration=1)
    return fitted


def _settings(
    field_name: str,
    sequence: RgbdSequence,
    field_config: FieldConfig,
    config: MappingConfig,
    seed: int,
) -> dict[str, Any]:
    """What a checkpoint must have been made with, to be taken up."""
    return {
        "field": field_name, "seed": seed, "sequence": sequence.name, "frames": len(sequence),
        "field_config": as_dict(field_config), "mapping_config": as_dict(config),
    }  # fmt: skip


def _checked_state(checkpoint: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """A checkpoint's content. Raises DataError if it was made with other settings."""
    state = read_checkpoint(checkpoint)
    with naming_damaged(checkpoint):
        found = state["settings"]
    if found != settings:
        changed = [name for name in settings if found.get(name) != settings[name]]
        raise DataError(
            f"{checkpoint} was made with another {', '.join(changed)}: "
            "remove it, or choose another output folder"
        )
    return state


def _write_map(
    checkpoint: Path, settings: dict[str, Any], fitted: FittedMap, iteration: int, **rest: Any
) -> None:
    bounds = fitted.field.bounds
    buffer = io.BytesIO()
    torch.save(
        {
            "settings": settings,
            "bounds": (bounds.minimum, bounds.maximum),
            "field": fitted.field.state_dict(),
            **rest,
            "iteration": iteration,
            "seconds": fitted.seconds,
            "history": {
                name: torch.tensor(column.to_numpy()) for name, column in fitted.history.items()
            },
        },
        buffer,
    )
    write_bytes_atomic(checkpoint, buffer.getvalue())


def learning_rate(config: MappingConfig, iteration: int) -> float:
    """Adam's learning rate: a cosine from its start down to a twentieth. Source: NeuS."""
    progress = iteration / config.iterations
    share = _FINAL_RATE + (1 - _FINAL_RATE) * (1 + math.cos(math.pi * progress)) / 2
    return config.learning_rate * share
