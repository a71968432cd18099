"""Fit a field to posed RGB-D frames: one loop for every field, with checkpoints and resume."""

import math
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from nbtrack.core.arrays import Frames
from nbtrack.data.pixels import PixelSampler
from nbtrack.data.sequence import RgbdSequence, observed_bounds
from nbtrack.fields import LearnedField, MappingSettings, field_class, make_field
from nbtrack.machinery.device import advise_on_memory, device_name, suited_to, threads, usual_modes
from nbtrack.machinery.errors import ConfigError, NumericalError, check_argument, typed
from nbtrack.machinery.files import Checkpoint
from nbtrack.machinery.inputs import whole_number
from nbtrack.machinery.launches import RepeatedWork, make_adam
from nbtrack.machinery.settings import checked
from nbtrack.mapping.files import Map
from nbtrack.mapping.holdout import split_holdout, usual_misfit

_PENDING = 10  # iterations whose losses are read together, since each reading waits for a GPU
_FINAL_RATE = 0.05  # learning rate at the end, relative to the start (NeuS)

OnIteration = Callable[[float, dict[str, float]], object]
"""Called every few iterations with the share of iterations done (0 to 1) and the latest losses."""


def learning_rate(settings: MappingSettings, iteration: int) -> float:
    """Adam's learning rate at an iteration: it falls along a cosine to 1/20 (Source: NeuS)."""
    progress = iteration / settings.iterations
    share = _FINAL_RATE + (1 - _FINAL_RATE) * (1 + math.cos(math.pi * progress)) / 2
    return settings.learning_rate * share


@typed
@usual_modes()
def map_sequence(
    field_name: str,
    sequence: RgbdSequence,
    network: Any,
    settings: Any,
    seed: int = 0,
    device: torch.device | None = None,
    checkpoint: Path | str | None = None,
    on_iteration: OnIteration = lambda done, losses: None,
    code: str = "",
) -> Map:
    """Fit a field to a sequence with known poses; a field that learns nothing is computed from it.

    `network` is of the field's class `Network` (None: it has none), `settings` of its `Settings`. A
    killed run goes on from the file `checkpoint`, with the batches of an uninterrupted run; the
    caller removes it. `code`, any text, tells versions of the program apart. Raises DataError for
    a frame without pose, no depth at all, or another map's checkpoint; ConfigError; NumericalError.
    """
    bounds = observed_bounds(sequence)
    kind = field_class(field_name)
    settings = checked(settings, kind.Settings)
    network = checked(network, kind.Network) if issubclass(kind, LearnedField) else None
    recipe = recipe_of(field_name, sequence, network, settings, seed)
    mapped, _ = split_holdout(len(sequence), settings.holdout_every)  # indices of frames
    if issubclass(kind, LearnedField):
        with advise_on_memory(f"mapping.{field_name}.n_rays={settings.n_rays}"):
            with threads(1):  # on more, sums are rounded otherwise, and so are initial weights
                field = make_field(field_name, network, bounds, seed).to(device)
            with suited_to(field.width, settings.tf32):
                fit = _Fit(recipe | {"code": code}, settings, field, sequence, mapped)
                fit.run(checkpoint, on_iteration)
        history, seconds = fit.history, fit.seconds
    else:
        start = time.perf_counter()
        field = kind.from_frames(sequence, mapped, bounds, settings).to(device)
        history, seconds = [field.diagnostics()], time.perf_counter() - start
        on_iteration(1.0, history[0])
    made = {"seconds": seconds, "mapped_frames": len(mapped), "device": device_name(field.device)}
    record = recipe | made | {"misfit_m": usual_misfit(field, sequence, mapped)}
    return Map(field, sequence.intrinsics, record, pd.DataFrame(history).rename_axis("iteration"))


def recipe_of(
    field_name: str, sequence: RgbdSequence, network: Any, settings: Any, seed: int
) -> dict[str, Any]:
    """All that determines a map besides the program and the device, as plain values."""
    return {
        "field": field_name,
        "scene": sequence.name,
        "n_frames": len(sequence),
        "first_and_last_frame": sequence.frame_ids[[0, -1]].tolist(),
        "data": sequence.digest,
        "origin": sequence.origin.tolist(),
        "seed": whole_number("seed", seed),
        "network": asdict(network) if network else {},
        "settings": asdict(settings),
    }


class _Fit:
    """A fit in progress: field, optimiser, the frames that batches are drawn from, and losses."""

    def __init__(
        self, recipe: dict, settings: Any, field: LearnedField, seen: RgbdSequence, mapped: Frames
    ) -> None:
        """Prepare to fit a field to the frames `mapped` of the sequence `seen`."""
        # The type of device is part of the recipe, since each type draws other random numbers.
        self.recipe = {**recipe, "device": field.device.type}
        self.settings = settings
        self.field = field
        parameters = {"params": [*field.parameters()], "lr": settings.learning_rate}
        self.optimizer = make_adam([parameters], field.device)
        self.rate = self.optimizer.param_groups[0]["lr"]  # a tensor, since recorded steps read it
        self.generator = torch.Generator(field.device).manual_seed(recipe["seed"])
        self.sampler = PixelSampler(seen, field.device)
        self.frames = torch.from_numpy(mapped).to(field.device)
        self.descent = RepeatedWork(f"mapping {field.name}", self.generator)
        field.prepare(seen, mapped)
        self.seconds = 0.0
        self.history = []
        self.terms: list[str] = []  # names of the loss terms; empty until the first batch

    def run(self, checkpoint: Path | str | None, on_iteration: OnIteration) -> None:
        """Fit from the checkpoint, if any, to the last iteration; then make the field constant."""
        file = Checkpoint(checkpoint, self.recipe)
        file.resume(self._take_up)
        end = self.settings.iterations
        for first in range(len(self.history), end, _PENDING):
            self._advance(range(first, min(end, first + _PENDING)))
            on_iteration(len(self.history) / end, self.history[-1])
            file.save(self._state, is_last=len(self.history) == end)
        self.field.eval().requires_grad_(False)

    def _advance(self, iterations: range) -> None:
        """Take some steps, then read all their losses together, since reading waits for a GPU.

        Raises NumericalError for a loss that is not finite.
        """
        start = time.perf_counter()
        pending = []
        for iteration in iterations:
            self.rate.fill_(learning_rate(self.settings, iteration))
            pending.append(self.descent.run(self._descend))
        diagnostics = self.field.diagnostics()  # after the last of the steps; recorded with each
        for iteration, row in zip(iterations, torch.stack(pending).tolist(), strict=True):
            values = dict(zip(self.terms, row, strict=True))
            if not all(map(math.isfinite, row)):
                found = f"losses {values} at mapping iteration {iteration}"
                raise NumericalError(f"{found}: lower the learning rate or check depth and poses")
            self.history.append({**values, "total": sum(row), **diagnostics})
        self.seconds += time.perf_counter() - start

    def _descend(self) -> torch.Tensor:
        """Take one step of Adam on a batch; returns the losses before it, ordered as `terms`.

        Raises ConfigError if the field's losses are no dictionary or have other names than before.
        """
        draw = partial(self.sampler.draw, generator=self.generator, frames=self.frames)
        terms = self.field.mapping_losses(draw, self.settings, self.generator)
        found = f"mapping_losses of {self.field.name}"
        check_argument(found, terms, dict)
        if self.terms and [*terms] != self.terms:
            advice = "give the same terms every time, 0 where one is not used"
            found += f" gave {', '.join(terms)} after {', '.join(self.terms)}"
            raise ConfigError(f"{found}: {advice}")
        self.terms = [*terms]
        losses = torch.stack([*terms.values()])
        self.optimizer.zero_grad()
        losses.sum().backward()
        self.optimizer.step()
        return losses.detach()

    def _state(self) -> dict[str, Any]:
        """All that the next iteration depends on, for a checkpoint."""
        state = {"field": self.field.state_dict(), "optimizer": self.optimizer.state_dict()}
        state |= {"seconds": self.seconds, "history": self.history}
        return {**state, "generator": self.generator.get_state()}

    def _take_up(self, state: dict[str, Any]) -> None:
        """Restore what `_state` returned."""
        self.field.load_state_dict(state["field"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.optimizer.param_groups[0]["lr"] = self.rate  # the tensor that `_advance` fills
        self.generator.set_state(state["generator"])
        self.seconds, self.history = state["seconds"], state["history"]
