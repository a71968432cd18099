"""Maps as jobs. A map is made from a scene, or is a finished one that the user gives."""

from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np

from nbtrack import provenance
from nbtrack.beyond.correction import correct_map
from nbtrack.beyond.grid import checked_size
from nbtrack.data.sequence import observed_bounds
from nbtrack.experiments.jobs import Job, Report
from nbtrack.experiments.presets import Preset, default_settings
from nbtrack.experiments.quality import score_map
from nbtrack.experiments.scenes import Scene
from nbtrack.fields import FIELDS, field_class
from nbtrack.machinery.device import choose_device
from nbtrack.machinery.files import absolute, fingerprint
from nbtrack.machinery.inputs import whole_number
from nbtrack.mapping.files import CHECKPOINT_FILE, HISTORY_FILE, MAP_FILE, Map, read_map, write_map
from nbtrack.mapping.fit import map_sequence
from nbtrack.plots.scene import up_of
from nbtrack.recordings.reading import read_frames

_FRAMES_LOOKED_AT = 20  # at most so many, to estimate the unit of a map before the map is made


@dataclass(frozen=True)
class MapJob(Job):
    """One map: a field that is fitted to some frames of a scene, and perhaps corrected by them.

    A map that the user gives is only read, and has no scene.
    """

    scene: Scene | None
    field: str
    network: Any  # settings of the field's network; None if the field has no network
    settings: Any  # of the mapping
    frames: str = ":"  # the slice of the scene's frames that are mapped
    seed: int = 0
    correction_voxel: float = 0.0  # m, the size of the cells of the correction; 0: no correction
    # m, the size of the cells of a correction that another job will make of this map. It is only
    # checked: if it is too fine, this job fails at once, and not that one after minutes of mapping.
    later_voxel: float = field(default=0.0, compare=False)
    given: Path | None = None  # the folder or file of the map that the user gives

    kind, doing = "maps", "mapping"
    work = 4.0  # with the preset `smoke`, mapping queries the field about as often as four runs

    @classmethod
    def of(cls, scene: Scene, field: str, preset: Preset, frames: str = ":", seed: int = 0) -> Self:
        """The job of a scene's map with the settings of a preset."""
        network, settings = preset.network_of(field), preset.mapping_of(field)
        seed, voxel = whole_number("seed", seed), preset.correction.get(field, 0.0)
        return cls(scene, field, network, settings, frames, seed, voxel)

    @classmethod
    def of_given(cls, path: Path) -> Self:
        """The job of a finished map that the user gives.

        Raises MissingError if there is no map, and DataError or ConfigError if it cannot be read.
        """
        finished = _stored(path)
        name, record = finished.field.name, finished.record
        network, settings = record["network"], record["settings"]
        voxel = record.get("correction", 0.0)  # m; `correct_map` records it
        return cls(None, name, network, settings, correction_voxel=voxel, given=path)

    @property
    def setting_tree(self) -> dict[str, Any]:
        """The map's settings as a tree, in the form of `Preset.settings`."""
        defaults = default_settings()
        # A field without network settings of its own uses those of NeuS.
        of_network = self.field if self.field in defaults["network"] else "neus"
        is_correctable = self.field in defaults["correction"]
        return {
            "network": {of_network: self.network} if self.network else {},
            "mapping": {self.field: self.settings},
            "correction": {self.field: self.correction_voxel} if is_correctable else {},
        }

    @cached_property
    def key(self) -> str:
        """A digest of code, versions, device, data, settings, frames and seed.

        The digest of a given map is of code, device, and the key that is stored with the map.
        """
        code = provenance.code_fingerprint(field_class(self.field))
        if self.given:
            return fingerprint(_stored(self.given).key, code, choose_device().type)
        recipe = self.field, self.network, self.settings, self.correction_voxel, self.seed
        program = code, provenance.versions(), choose_device().type
        return fingerprint(*recipe, *program, self.scene.fingerprint, self.frames)

    @property
    def name(self) -> str:
        """The scene and the field, whether the map is corrected, and the seed if it is not 0."""
        name = f"{self.scene.name}-{self.field}{'-corrected' if self.correction_voxel else ''}"
        return f"{name}-seed{self.seed}" if self.seed else name

    @cached_property
    def needs(self) -> "MapJob | None":
        """The job of the plain map that a corrected map is made from.

        None for a plain map, and for a given map, which is not made.
        """
        if self.given or not self.correction_voxel:
            return None
        return replace(self, correction_voxel=0.0, later_voxel=self.correction_voxel)

    @property
    def folder(self) -> Path:
        """The map's folder in the cache; for a given map the user's folder or file."""
        return self.given or super().folder

    @property
    def is_done(self) -> bool:
        """Whether the map is finished and scored."""
        return self.given is not None or (self.folder / MAP_FILE).is_file()

    def result(self) -> dict[str, Any]:
        """A record of how the finished map was made, with its scores."""
        return deepcopy(_stored(self.folder).record)

    def map(self) -> Map:
        """The finished map on the device that computes; a copy, which the caller may change."""
        finished = deepcopy(_stored(self.folder))
        return replace(finished, field=finished.field.to(choose_device()))

    def compute(self, report: Report) -> dict[str, Any]:
        """Make the map, or resume from a checkpoint; score it and write its files.

        Returns the map's record.
        """
        checkpoint = self.folder / CHECKPOINT_FILE

        def report_losses(share: float, losses: dict[str, float | int]) -> None:
            report(share, " ".join(f"{name} {loss:.3f}" for name, loss in losses.items()))

        sequence = self.scene.read(self.frames)
        if self.later_voxel:  # raises an error if cells of this size are too fine
            checked_size(observed_bounds(sequence), self.later_voxel, f"correction.{self.field}")
        if self.needs:
            finished = correct_map(self.needs.map(), sequence, self.correction_voxel)
        else:
            # The key as `code` makes a checkpoint of another key an error, as one copied to here.
            finished = map_sequence(
                self.field, sequence, self.network, self.settings, self.seed, choose_device(),
                checkpoint=checkpoint, on_iteration=report_losses, code=self.key,
            )  # fmt: skip
        record = {
            "quality": score_map(finished, sequence, self.scene.room),
            "up": up_of(sequence.T_world_camera).tolist(),
            "frames": self.frames,
            "key": self.key,
            "versions": provenance.versions(),
        }
        finished = replace(finished, record=finished.record | record)
        write_map(self.folder / MAP_FILE, finished)
        checkpoint.unlink(missing_ok=True)
        return finished.record


def map_unit(job: MapJob) -> float:
    """Metres in a unit of a job's map; if it is still to be made, an estimate from a few frames."""
    if job.is_done:
        return _stored(job.folder).field.bounds.metres_per_unit
    ids = job.scene.select(job.frames)
    places = np.linspace(0, len(ids) - 1, min(len(ids), _FRAMES_LOOKED_AT)).astype(int)
    return observed_bounds(read_frames(job.scene.recording, ids[places])).metres_per_unit


def _stored(path: Path) -> Map:
    """The map in a folder or file.

    Its files are read again only if they changed, or if a class of fields was registered since.
    """
    path = absolute(path)
    parts = (path / MAP_FILE, path / HISTORY_FILE) if path.is_dir() else (path,)
    modified_ns = tuple(part.stat().st_mtime_ns for part in parts if part.is_file())
    return _read(path, modified_ns, tuple(FIELDS.items()))


@lru_cache(maxsize=4)
def _read(path: Path, modified_ns: tuple[int, ...], fields: tuple) -> Map:
    """The map in a folder or file, kept in memory for all runs in it.

    Reading a corrected map takes seconds. `modified_ns` (the times of the files, in ns) and
    `fields` (the registered classes) are only parts of the key under which the map is kept.
    """
    return read_map(path)
