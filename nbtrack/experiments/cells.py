"""Cells, each named by all that it depends on and made once; and maps as cells."""

import abc
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from nbtrack.core.device import advise_on_memory, choose_device
from nbtrack.core.errors import NbtrackError
from nbtrack.core.files import fingerprint, foreign_source, runs_folder, sources_fingerprint
from nbtrack.core.settings import as_dict
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.scenes import Scene
from nbtrack.fields import field_class
from nbtrack.mapping.files import CHECKPOINT_FILE, MAP_FILE, Map, read_map, write_map
from nbtrack.mapping.fit import map_sequence
from nbtrack.mapping.quality import score_map

SHARED_SOURCES = ("core.geometry", "core.camera", "core.bounds", "data", "fields")
"""What maps and runs both go through, beside their own rooms."""
Report = Callable[[int, str], None]
"""Called by a cell with the units done so far and a word on how it goes."""

_RECENT: dict[tuple[Path, str], Map] = {}  # maps that this process has made or read lately
_MOST_RECENT = 4


class Cell(abc.ABC):
    """One piece of work: picklable, kept in a folder of its own, perhaps made of another's."""

    kind: str  # the part of the cache where it is kept
    name: str  # for readers
    key: str  # changes with everything that the result depends on
    out: Path | None = None  # where to keep it instead of in the cache
    units: int  # that it reports: iterations or frames
    cost: float  # work in all, relative to other cells: its share of the bar
    needs: "Cell | None"
    is_done: bool

    @property
    def cache(self) -> Path:
        """Its folder in the cache."""
        return runs_folder() / self.kind / f"{self.name}-{self.key}"

    @property
    def folder(self) -> Path:
        """Where its files are kept."""
        return self.out or self.cache

    @abc.abstractmethod
    def result(self) -> Any:
        """What a finished cell has kept."""

    @abc.abstractmethod
    def compute(self, report: Report) -> Any:
        """Make it, or take a killed attempt up where it stands; returns `result`."""

    def make(self, report: Report) -> Any:
        """Compute it, or wait for the process that does, and find it done; returns `result`.

        The lock is the system's, which frees it when that process ends, however it ends.
        """
        path = runs_folder() / "locks" / f"{self.cache.name}.lock"
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(path)
        try:
            held = lock.acquire(timeout=0)
        except Timeout:
            report(0, "waits for another process that makes the same")
            held = lock.acquire()
        with held:
            return self.result() if self.is_done else self.compute(report)

    def outcome(self, needed: Any, report: Report) -> Any:
        """What `make` returns, or the user's mistake that it met, or was kept from it by."""
        if isinstance(needed, NbtrackError):
            return NbtrackError(f"not run, because {self.needs.name} failed: {needed}")
        try:
            return self.make(report)
        except NbtrackError as error:
            return error


@dataclass(frozen=True)
class MapCell(Cell):
    """One map: a field fitted to some frames of a scene, or a map made earlier in its place."""

    scene: Scene
    field: str
    preset: Preset
    frames: str = ":"
    seed: int = 0
    out: Path | None = None
    given: Map | None = None  # the scene is tracked in this one, read from:
    given_path: Path | None = None

    kind, needs = "maps", None

    @cached_property
    def key(self) -> str:
        """Of code, device, data, settings and seed."""
        if self.given:
            return fingerprint(self.given.key, choose_device().type, self.scene.fingerprint)
        code = sources_fingerprint(*SHARED_SOURCES, "mapping")
        return fingerprint(
            code, foreign_source(field_class(self.field)), choose_device().type,
            self.scene.fingerprint, self.field, self.preset.network_of(self.field), self.settings,
            self.frames, self.seed,
        )  # fmt: skip

    @property
    def settings(self) -> Any:
        """Settings of the mapping."""
        return self.preset.mapping_of(self.field)

    @property
    def name(self) -> str:
        """Scene and field, and the seed if it is not the first."""
        return f"{self.scene.name}-{self.field}{seed_suffix(self.seed)}"

    @property
    def units(self) -> int:
        """Iterations."""
        return getattr(self.settings, "iterations", 1)

    @property
    def cost(self) -> float:
        """Points that the network is asked for, all told; of what learns nothing, next to none."""
        if not hasattr(self.settings, "n_rays"):
            return 1e6
        samples = self.settings.n_stratified + self.settings.n_surface
        return float(self.units * self.settings.n_rays * samples)

    @property
    def is_done(self) -> bool:
        """Whether the map is finished and scored; in a folder of the user's, whether it is this."""
        if self.given or not (self.folder / MAP_FILE).is_file():
            return self.given is not None
        return self.out is None or read_map(self.folder).made.get("key") == self.key

    def result(self) -> dict[str, Any]:
        """How the finished map was made, and its scores."""
        return self.map().made

    def map(self) -> Map:
        """The finished map, ready for tracking; from disk only where another process made it."""
        found = self.given or _RECENT.get((self.folder, self.key)) or read_map(self.folder)
        return self._keep(replace(found, field=found.field.to(choose_device())))

    def compute(self, report: Report) -> dict[str, Any]:
        """Map and score, or resume; write the map's files."""
        checkpoint = self.folder / CHECKPOINT_FILE
        with advise_on_memory(f"frames {self.frames} of {self.scene.name}"):
            sequence = self.scene.read(self.frames)
            made = map_sequence(
                self.field, sequence, self.preset.network_of(self.field), self.settings,
                self.seed, choose_device(), checkpoint,
                lambda done, losses: report(done, _told(losses)),
            )  # fmt: skip
            quality = score_map(made, sequence, self.scene.room)
        told = {"quality": quality, "frames": self.frames, "key": self.key}
        finished = replace(made, made={**made.made, **told, "config": as_dict(self.preset)})
        write_map(self.folder / MAP_FILE, finished)
        checkpoint.unlink(missing_ok=True)
        return self._keep(finished).made

    def _keep(self, found: Map) -> Map:
        place = (self.folder, self.key)
        while len(_RECENT) >= _MOST_RECENT and place not in _RECENT:
            _RECENT.pop(next(iter(_RECENT)))
        return _RECENT.setdefault(place, found)


def _told(losses: dict[str, float | int]) -> str:
    return " ".join(f"{name} {value:.3f}" for name, value in losses.items())


def seed_suffix(seed: int) -> str:
    """Part of a cell's name: nothing for the first seed."""
    return f"-seed{seed}" if seed else ""
