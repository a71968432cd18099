"""Maps as cells: each is named by all that it depends on, and made once."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from nbtrack.core.device import advise_on_memory, choose_device
from nbtrack.core.files import fingerprint, foreign_source, runs_folder, sources_fingerprint
from nbtrack.core.settings import as_dict
from nbtrack.experiments.board import Cell, Report
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.scenes import Scene
from nbtrack.fields import field_class
from nbtrack.mapping.files import CHECKPOINT_FILE, MAP_FILE, Map, read_map, write_map
from nbtrack.mapping.fit import map_sequence
from nbtrack.mapping.quality import score_map

SHARED_SOURCES = ("core.geometry", "core.camera", "core.bounds", "data", "fields")
"""What maps and runs both go through, beside their own rooms."""

_RECENT: dict[tuple[Path, str], Map] = {}  # maps that this process has made or read lately
_MOST_RECENT = 4


@dataclass(frozen=True)
class MapCell(Cell):
    """One map: a field fitted to some frames of a scene, or a map made earlier in its place."""

    scene: Scene
    field: str
    preset: Preset
    frames: str = ":"
    seed: int = 0
    out: Path | None = None  # where to keep it instead of in the cache
    given: Map | None = None  # the scene is tracked in this one, read from:
    given_path: Path | None = None

    needs = None

    @cached_property
    def key(self) -> str:
        """Changes with everything that the map depends on: code, device, data, settings, seed."""
        if self.given:
            return fingerprint(self.given.key, choose_device().type, self.scene.fingerprint)
        code = sources_fingerprint(*SHARED_SOURCES, "mapping")
        network, settings = self.preset.network_of(self.field), self.preset.mapping_of(self.field)
        return fingerprint(
            code, foreign_source(field_class(self.field)), choose_device().type,
            self.scene.fingerprint, self.field, network, settings, self.frames, self.seed,
        )  # fmt: skip

    @property
    def name(self) -> str:
        """A readable name: scene and field, and the seed if it is not the first."""
        return f"{self.scene.name}-{self.field}{seed_suffix(self.seed)}"

    @property
    def folder(self) -> Path:
        """Where the map is kept."""
        return self.out or runs_folder() / "maps" / f"{self.name}-{self.key}"

    @property
    def units(self) -> int:
        """Iterations."""
        return getattr(self.preset.mapping_of(self.field), "iterations", 1)

    @property
    def cost(self) -> float:
        """Points that the network is asked for, all told: a measure of the work."""
        settings = self.preset.mapping_of(self.field)
        if not hasattr(settings, "n_rays"):
            return 1e6
        samples = settings.n_stratified + settings.n_surface
        return float(settings.iterations * settings.n_rays * samples)

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
        if self.given:
            return replace(self.given, field=self.given.field.to(choose_device()))
        place = (self.folder, self.key)
        if place not in _RECENT:
            found = read_map(self.folder)
            _remember(place, replace(found, field=found.field.to(choose_device())))
        return _RECENT[place]

    def make(self, report: Report) -> dict[str, Any]:
        """Map now, or resume, or wait for the process that does; returns `result`."""
        with cell_lock(self.folder, report):
            if not self.is_done:
                self._make(report)
        return self.result()

    def _make(self, report: Report) -> None:
        settings = self.preset.mapping_of(self.field)
        checkpoint = self.folder / CHECKPOINT_FILE
        with advise_on_memory(f"frames {self.frames} of {self.scene.name}"):
            sequence = self.scene.read(self.frames)
            made = map_sequence(
                self.field, sequence, self.preset.network_of(self.field), settings, self.seed,
                choose_device(), checkpoint, lambda done, losses: report(done, _told(losses)),
            )  # fmt: skip
            quality = score_map(made, sequence, self.scene.room)
        told = {"quality": quality, "frames": self.frames, "key": self.key}
        finished = replace(made, made={**made.made, **told, "config": as_dict(self.preset)})
        write_map(self.folder / MAP_FILE, finished)
        checkpoint.unlink(missing_ok=True)
        _remember((self.folder, self.key), finished)


def _remember(place: tuple[Path, str], found: Map) -> None:
    while len(_RECENT) >= _MOST_RECENT:
        _RECENT.pop(next(iter(_RECENT)))
    _RECENT[place] = found


@contextmanager
def cell_lock(folder: Path, report: Report) -> Iterator[None]:
    """Keep a cell to one process at a time; the system frees it when that process ends.

    Whoever comes second waits, says so, and then finds the cell done.
    """
    path = runs_folder() / "locks" / f"{folder.name}.lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        report(0, "waits for another process that makes the same")
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def _told(losses: dict[str, float | int]) -> str:
    return " ".join(f"{name} {value:.3f}" for name, value in losses.items())


def seed_suffix(seed: int) -> str:
    """Part of a cell's name: nothing for the first seed."""
    return f"-seed{seed}" if seed else ""
