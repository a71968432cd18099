"""The cells of a grid: maps and tracked runs, each named by everything that it depends on."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout

from nbtrack.core.config import Preset
from nbtrack.core.device import choose_device, device_name, synchronize
from nbtrack.core.errors import ConfigError
from nbtrack.core.files import read_json
from nbtrack.core.paths import runs_folder
from nbtrack.core.provenance import code_fingerprint, fingerprint
from nbtrack.experiments.scenes import Scene
from nbtrack.fields import field_class
from nbtrack.fields.grid import bake_field
from nbtrack.mapping.files import SUMMARY_FILE, StoredMap
from nbtrack.mapping.fit import map_sequence
from nbtrack.mapping.quality import score_map
from nbtrack.tracking.budget import Budget, ClockBudget, StepBudget
from nbtrack.tracking.metrics import trajectory_metrics
from nbtrack.tracking.sequence import track_sequence
from nbtrack.tracking.trackers import tracker_class

RUN_FILE, METRICS_FILE = "run.pt", "metrics.json"


@dataclass(frozen=True)
class MapCell:
    """One map: a field fitted to some frames of a scene."""

    scene: Scene
    field_name: str
    preset: Preset
    frames: str = ":"
    seed: int = 0
    out: Path | None = None  # where to keep it instead of in the cache

    @cached_property
    def key(self) -> str:
        """Changes with everything that the map depends on: code, device, data, settings, seed."""
        field = field_class(self.field_name)
        return fingerprint(
            code_fingerprint(map_sequence, score_map, field), choose_device().type,
            self.scene.fingerprint,
            self.field_name, self.preset.network_of(self.field_name),
            self.preset.mapping_of(self.field_name), self.frames, self.seed,
        )  # fmt: skip

    @property
    def name(self) -> str:
        """A readable name: scene and field, and the seed if it is not the first."""
        return f"{self.scene.name}-{self.field_name}{_seed_suffix(self.seed)}"

    @property
    def folder(self) -> Path:
        """Where the map is kept."""
        return self.out or runs_folder() / "maps" / f"{self.name}-{self.key}"

    @property
    def is_done(self) -> bool:
        """Whether the map is finished and scored; in a folder of the user's, whether it is this."""
        path = self.folder / SUMMARY_FILE
        if self.out is None or not path.is_file():
            return path.is_file()
        return read_json(path).get("key") == self.key

    @property
    def evaluations(self) -> float:
        """Points that the network is asked for, all told: a measure of the work."""
        config = self.preset.mapping_of(self.field_name)
        samples = config.n_stratified + config.n_surface
        return float(config.iterations * config.n_rays * samples)


@dataclass(frozen=True)
class GivenMap:
    """A map made earlier in the place of a scene's own: in it the scene is tracked."""

    scene: Scene
    preset: Preset  # its network is the map's
    stored: StoredMap

    @property
    def field_name(self) -> str:
        """The map's field."""
        return self.stored.field.name

    @property
    def frames(self) -> str:
        """The slice of frames, of its own scene, that the map was made from."""
        return self.stored.made["frames"]

    @property
    def seed(self) -> int:
        """The seed that the map was made with."""
        return self.stored.made["seed"]

    @cached_property
    def key(self) -> str:
        """Changes with the map's weights and with the scene that is tracked."""
        return fingerprint(self.stored.key, choose_device().type, self.scene.fingerprint)


@dataclass(frozen=True)
class TrackCell:
    """One tracked run in a map, under one budget: so many steps a frame, or a rate by the clock."""

    map_cell: MapCell | GivenMap
    tracker_name: str
    steps: float | None = None
    rate_hz: float | None = None
    frames: str = ":"
    seed: int = 0

    @cached_property
    def key(self) -> str:
        """Changes with everything that the run depends on; by the clock, with the machine too."""
        tracker = tracker_class(self.tracker_name)
        config = self.map_cell.preset.tracking_of(self.tracker_name)
        machine = (device_name(choose_device()), torch.get_num_threads())
        clock = None if self.rate_hz is None else (self.rate_hz, *machine)
        baking = (bake_field,) if config.bake_voxel else ()
        return fingerprint(
            code_fingerprint(track_sequence, trajectory_metrics, tracker, *baking),
            self.map_cell.key,
            self.tracker_name, config, self.steps, clock, self.frames, self.seed,
        )  # fmt: skip

    @property
    def scene_name(self) -> str:
        """The tracked scene."""
        return self.map_cell.scene.name

    @property
    def name(self) -> str:
        """A readable name: scene, tracker and budget, and the seed if it is not the first."""
        budget = f"{self.rate_hz:g}hz" if self.rate_hz else f"{self.steps:g}steps"
        return f"{self.scene_name}-{self.tracker_name}-{budget}{_seed_suffix(self.seed)}"

    @property
    def folder(self) -> Path:
        """Where the run's files are kept."""
        return runs_folder() / "tracks" / f"{self.name}-{self.key}"

    @property
    def is_done(self) -> bool:
        """Whether the run is finished."""
        return (self.folder / METRICS_FILE).is_file()

    @property
    def n_frames(self) -> int:
        """Frames to track, after the first one, whose pose is given."""
        return len(self.map_cell.scene.frame_numbers(self.frames)) - 1

    @property
    def evaluations(self) -> float:
        """Points that the network is asked for with a step budget: a measure of the work."""
        config = self.map_cell.preset.tracking_of(self.tracker_name)
        a_pixel = tracker_class(self.tracker_name).evaluations_per_pixel(config)
        return float(self.n_frames * (self.steps or 0) * config.n_pixels * a_pixel)

    def budget(self, device: torch.device) -> Budget:
        """A fresh budget: each run needs its own."""
        return make_budget(self.steps, self.rate_hz, device)

    def metrics(self) -> dict[str, Any]:
        """What a finished run keeps: errors, speed, device, versions, settings."""
        return read_json(self.folder / METRICS_FILE)


def make_budget(
    steps: float | int | None, rate_hz: float | int | None, device: torch.device | None = None
) -> Budget:
    """A budget by the clock of a device if there is a rate (Hz), else of so many steps a frame.

    Raises:
        ConfigError: the number is not above zero.
    """
    if rate_hz is None:
        return StepBudget(steps)
    wait = partial(synchronize, device) if device else None
    return ClockBudget(rate_hz, synchronize=wait)


def check_pair(tracker_name: str, field_name: str, bake_voxel: float) -> None:
    """Whether a tracker works in the maps of a field, baked or not.

    Raises:
        ConfigError: one is unknown, or they do not go together.
    """
    tracker, field = tracker_class(tracker_name), field_class(field_name)
    if not issubclass(field, field_class(tracker.field_name)):
        raise ConfigError(
            f"tracker {tracker_name!r} does not work on field {field_name!r}: "
            f"{tracker.label} needs --field {tracker.field_name}"
        )
    if bake_voxel and tracker.renders:
        raise ConfigError(
            f"tracker {tracker_name!r} renders, which a baked field cannot: leave --bake out, or "
            "take --tracker sdf or lm"
        )


@contextmanager
def cell_lock(folder: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Keep a cell to one process at a time; the system frees it when that process ends.

    Whoever comes second waits, says so, and then finds the cell done.
    """
    path = runs_folder() / "locks" / f"{folder.name}.lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        say("waits for another process that makes the same")
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def _seed_suffix(seed: int) -> str:
    return f"-seed{seed}" if seed else ""
