"""Jobs, each named by all that it depends on and made once; and maps as jobs."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from filelock import FileLock

from nbtrack.core.device import advise_on_memory, choose_device
from nbtrack.core.errors import NbtrackError
from nbtrack.core.files import code_fingerprint, fingerprint, runs_folder
from nbtrack.core.settings import as_dict, with_settings
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.scenes import Scene
from nbtrack.fields import field_class
from nbtrack.mapping.correct import correct_map
from nbtrack.mapping.files import CHECKPOINT_FILE, MAP_FILE, Map, read_map, write_map
from nbtrack.mapping.fit import check_recipe, map_sequence, recipe_of
from nbtrack.mapping.quality import score_map

Report = Callable[[float, str], None]
"""Called by a job with the share of it that is done and a word on how it goes."""


class Job:
    """One piece of work: picklable, kept in a folder of its own, perhaps made of another's."""

    kind: str  # the part of the cache where it is kept
    name: str  # for readers
    key: str  # changes with everything that the result depends on
    out: Path | None = None  # where to keep it instead of in the cache
    needs: "Job | None"
    is_done: bool
    result: Callable[[], Any]  # what a finished job has kept
    compute: Callable[[Report], Any]  # makes it, or takes a killed attempt up; returns `result`

    @property
    def cache(self) -> Path:
        """Its folder in the cache."""
        return runs_folder() / self.kind / f"{self.name}-{self.key}"

    @property
    def folder(self) -> Path:
        """Where its files are kept."""
        return self.out or self.cache

    def outcome(self, needed: Any, report: Report) -> Any:
        """Its `result`, made where it is missing, or the user's mistake that kept it from that.

        What another process is computing is waited for. The lock is the system's, which frees it
        when that process ends, however it ends.
        """
        if isinstance(needed, NbtrackError):
            return NbtrackError(f"not run, because {self.needs.name} failed: {needed}")
        path = runs_folder() / "locks" / f"{self.cache.name}.lock"
        report(0.0, "begins, or waits for another process that makes the same")
        try:
            with FileLock(path), advise_on_memory(f"the frames and settings of {self.name}"):
                return self.result() if self.is_done else self.compute(report)
        except NbtrackError as error:
            return error


@dataclass(frozen=True)
class MapJob(Job):
    """One map: a field fitted to some frames of a scene, or a map made earlier in its place."""

    scene: Scene
    field: str
    preset: Preset
    frames: str = ":"
    seed: int = 0
    out: Path | None = None
    is_given: bool = False  # made elsewhere, and only read: `out` is its folder, or its file

    kind, needs = "maps", None

    @cached_property
    def key(self) -> str:
        """Of code, device, data, settings and seed."""
        if self.is_given:
            given = read_map(self.folder)
            return fingerprint(given.key, code_fingerprint(type(given.field)), choose_device().type)
        correction = ["nbtrack.mapping.correct"] if self.base else []
        return fingerprint(
            code_fingerprint(field_class(self.field), "nbtrack.mapping.fit", *correction),
            choose_device().type, self.scene.fingerprint, self.field,
            self.preset.network_of(self.field), self.settings, self.frames, self.seed,
        )  # fmt: skip

    @property
    def settings(self) -> Any:
        """Settings of the mapping."""
        return self.preset.mapping_of(self.field)

    @property
    def name(self) -> str:
        """Scene and field, and the seed if it is not the first."""
        name = f"{self.scene.name}-{self.field}"
        if self.base is not None:
            name += "-corrected"
        return f"{name}-seed{self.seed}" if self.seed else name

    @property
    def base(self) -> "MapJob | None":
        """The map that this one corrects, if it is a corrected one."""
        if not getattr(self.settings, "correct_voxel", 0.0):
            return None
        preset = with_settings(self.preset, f"mapping.{self.field}.correct_voxel=0.0")
        return replace(self, preset=preset, out=None)

    @property
    def is_done(self) -> bool:
        """Whether the map is finished and scored; in a folder of the user's, whether it is this."""
        if self.is_given or not (self.folder / MAP_FILE).is_file():
            return self.is_given
        return self.out is None or read_map(self.folder).record.get("key") == self.key

    def result(self) -> dict[str, Any]:
        """How the finished map was made, and its scores."""
        return self.map().record

    def map(self) -> Map:
        """The finished map, ready for tracking."""
        finished = _read(self.folder, self.key)
        return replace(finished, field=finished.field.to(choose_device()))

    def compute(self, report: Report) -> dict[str, Any]:
        """Map and score, or resume; write the map's files."""
        iterations = getattr(self.settings, "iterations", 1)
        checkpoint, base = self.folder / CHECKPOINT_FILE, self.base

        def tell(done: int, losses: dict[str, float | int]) -> None:
            words = [f"{name} {loss:.3f}" for name, loss in losses.items()]
            report(done / iterations, " ".join(words))

        if base and isinstance(failure := base.outcome(None, report), NbtrackError):
            raise failure
        sequence, network = self.scene.read(self.frames), self.preset.network_of(self.field)
        parts = self.field, sequence, network, self.settings, self.seed
        if (self.folder / MAP_FILE).is_file():  # a folder of the user's, with another finished map
            check_recipe(self.folder / MAP_FILE, read_map(self.folder).record, recipe_of(*parts))
        if base:
            finished_map = correct_map(base.map(), sequence, self.settings)
        else:
            finished_map = map_sequence(*parts, choose_device(), checkpoint, tell)
        quality = score_map(finished_map, sequence, self.scene.room)
        record = {"quality": quality, "frames": self.frames, "key": self.key}
        record = finished_map.record | record | {"config": as_dict(self.preset)}
        write_map(self.folder / MAP_FILE, replace(finished_map, record=record))
        checkpoint.unlink(missing_ok=True)
        return record


@lru_cache(maxsize=4)
def _read(folder: Path, key: str) -> Map:
    """Read once for all runs in a map."""
    return read_map(folder)
