"""Maps as jobs: made from a scene, or given."""

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

_FRAMES_LOOKED_AT = 20  # at most, to estimate a map's unit before there is a map


@dataclass(frozen=True)
class MapJob(Job):
    """One map: a field fitted to some frames of a scene, and perhaps corrected by them.

    One that the user gave is only read: it has no scene.
    """

    scene: Scene | None
    field: str
    network: Any  # settings of the field's network; None where it has none
    settings: Any  # of the mapping
    frames: str = ":"
    seed: int = 0
    correction_voxel: float = 0.0  # m, of the cells in which the map is corrected; 0: it is not
    # m, of the cells in which the job that needs this map will correct it. The size is only checked
    # before this map is made, which takes minutes.
    later_voxel: float = field(default=0.0, compare=False)
    given: Path | None = None  # the user's own map: its folder, or file

    kind, doing = "maps", "mapping"
    work = 4.0  # with `smoke` it asks the field about as many queries as four tracked runs

    @classmethod
    def of(cls, scene: Scene, field: str, preset: Preset, frames: str = ":", seed: int = 0) -> Self:
        """The map of a scene with the settings of a preset."""
        network, settings = preset.network_of(field), preset.mapping_of(field)
        seed, voxel = whole_number("seed", seed), preset.correction.get(field, 0.0)
        return cls(scene, field, network, settings, frames, seed, voxel)

    @classmethod
    def of_given(cls, path: Path) -> Self:
        """A finished map that the user gave. Raises as `read_map` does."""
        finished = _stored(path)
        name, record = finished.field.name, finished.record
        network, settings = record["network"], record["settings"]
        voxel = record.get("correction", 0.0)
        return cls(None, name, network, settings, correction_voxel=voxel, given=path)

    @property
    def setting_tree(self) -> dict[str, Any]:
        """Its settings as a tree of the form of `Preset.settings`."""
        defaults = default_settings()
        # A field that has no network settings of its own has those of NeuS.
        of_network = self.field if self.field in defaults["network"] else "neus"
        is_correctable = self.field in defaults["correction"]
        return {
            "network": {of_network: self.network} if self.network else {},
            "mapping": {self.field: self.settings},
            "correction": {self.field: self.correction_voxel} if is_correctable else {},
        }

    @cached_property
    def key(self) -> str:
        """A digest of code, device, data, settings and seed.

        For a given map it is one of code, device and the key that is stored with the map.
        """
        code = provenance.code_fingerprint(field_class(self.field))
        if self.given:
            return fingerprint(_stored(self.given).key, code, choose_device().type)
        recipe = self.field, self.network, self.settings, self.correction_voxel, self.seed
        program = code, provenance.versions(), choose_device().type
        return fingerprint(*recipe, *program, self.scene.fingerprint, self.frames)

    @property
    def name(self) -> str:
        """Scene and field, and the seed if it is not the first."""
        name = f"{self.scene.name}-{self.field}{'-corrected' if self.correction_voxel else ''}"
        return f"{name}-seed{self.seed}" if self.seed else name

    @cached_property
    def needs(self) -> "MapJob | None":
        """The map that this one corrects, if it is a corrected one."""
        if not self.correction_voxel:
            return None
        return replace(self, correction_voxel=0.0, later_voxel=self.correction_voxel)

    @property
    def folder(self) -> Path:
        """Where its files are in the cache; of a given map the user's folder or file."""
        return self.given or super().folder

    @property
    def is_done(self) -> bool:
        """Whether the map is finished and scored."""
        return self.given is not None or (self.folder / MAP_FILE).is_file()

    def result(self) -> dict[str, Any]:
        """How the finished map was made, and its scores."""
        return deepcopy(_stored(self.folder).record)

    def map(self) -> Map:
        """The finished map, ready for tracking: a copy of that in the cache."""
        finished = deepcopy(_stored(self.folder))
        return replace(finished, field=finished.field.to(choose_device()))

    def compute(self, report: Report) -> dict[str, Any]:
        """Map and score, or resume from a checkpoint; write the map's files. Returns its record."""
        checkpoint = self.folder / CHECKPOINT_FILE

        def report_losses(share: float, losses: dict[str, float | int]) -> None:
            report(share, " ".join(f"{name} {loss:.3f}" for name, loss in losses.items()))

        sequence = self.scene.read(self.frames)
        if self.later_voxel:  # raises now what would else be raised after minutes of mapping
            checked_size(observed_bounds(sequence), self.later_voxel, f"correction.{self.field}")
        if self.needs:
            finished = correct_map(self.needs.map(), sequence, self.correction_voxel)
        else:
            # `code` is the key, so that no checkpoint of another key is resumed.
            finished = map_sequence(
                self.field, sequence, self.network, self.settings, self.seed, choose_device(),
                checkpoint=checkpoint, on_iteration=report_losses, code=self.key,
            )  # fmt: skip
        record = {
            "quality": score_map(finished, sequence, self.scene.room),
            "up": up_of(sequence.T_world_camera).tolist(),
            "frames": self.frames,
            "key": self.key,
            "correction": self.correction_voxel,
            "versions": provenance.versions(),
        }
        finished = replace(finished, record=finished.record | record)
        write_map(self.folder / MAP_FILE, finished)
        checkpoint.unlink(missing_ok=True)
        return finished.record


def map_unit(job: MapJob) -> float:
    """Metres a unit of a map; an estimate for one that is still to be made."""
    if job.is_done:
        return job.map().field.bounds.metres_per_unit
    return _rough_unit(job.scene, job.frames)


@lru_cache
def _rough_unit(scene: Scene, frames: str) -> float:
    """Metres a unit of the map that will be made, estimated from a few of its frames."""
    ids = scene.select(frames)
    some = ids[np.linspace(0, len(ids) - 1, min(len(ids), _FRAMES_LOOKED_AT)).astype(int)]
    return observed_bounds(read_frames(scene.recording, some)).metres_per_unit


def _stored(path: Path) -> Map:
    """The map of a folder or file, read once in this process.

    It is read again where its files changed, or where a class was registered since.
    """
    path = absolute(path)
    parts = (path / MAP_FILE, path / HISTORY_FILE) if path.is_dir() else (path,)
    modified_ns = tuple(part.stat().st_mtime_ns for part in parts if part.is_file())
    return _read(path, modified_ns, tuple(FIELDS.items()))


@lru_cache(maxsize=4)
def _read(path: Path, modified_ns: tuple[int, ...], fields: tuple) -> Map:
    """The map of a folder or file, kept for all runs in it: reading a corrected one takes seconds.

    `modified_ns` and `fields` only belong to the cache's key: where one changes, the files are read
    again.
    """
    return read_map(path)
