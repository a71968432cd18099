"""A finished map, and the one file that holds it: safetensors, which run no code; all checked."""

import json
import math
import re
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import pandas as pd
import safetensors
import safetensors.torch
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.fields import FIELDS, Field
from nbtrack.machinery.device import usual_modes
from nbtrack.machinery.errors import ConfigError, MissingError, look_up
from nbtrack.machinery.files import absolute, digest_of, naming_damaged, write_together
from nbtrack.machinery.registry import Registry

MAP_FILE = "map.safetensors"
HISTORY_FILE = "history.csv"  # losses over iterations
MESH_FILE = "mesh.ply"  # what a map's frames have seen
CHECKPOINT_FILE = "mapping.pt"  # of a map in the making
_FORMAT = "nbtrack map"
_VERSION = 4
FORMS: Registry[type[Field]] = Registry({})
"""What may be made of a finished map's field, as a corrected one, by its name in map files."""
_AGAIN = "map again, and give the folder or its map.safetensors; an earlier nbtrack's are none"


@dataclass(frozen=True)
class Map:
    """A mapped scene, ready for tracking, with what is known of how it was made."""

    field: Field
    camera: Intrinsics  # of the frames it was made from
    # Plain values: scene, n_frames, seed, network, settings, misfit_m, device, versions, seconds
    # spent in iterations; and whatever its maker adds, as `quality`, scores by name.
    record: dict[str, Any]
    # One row an iteration: weighted loss terms and diagnostics. Empty where it was not kept.
    history: pd.DataFrame = field(default_factory=pd.DataFrame)

    @property
    def key(self) -> str:
        """Twelve hexadecimal digits that change with the field, its bounds and its weights."""
        field, network = self.field, self.record["network"]
        plain = [field.name, field.form, network, asdict(field.bounds)]
        return digest_of(plain, _tensors(field))[:12]


@usual_modes()
def write_map(path: Path | str, finished: Map) -> None:
    """Writes a map as one file, about 1 MB for the paper's network.

    Weights keep every bit, so that tracking in the file gives the trajectory of the map itself.
    In a folder the file is `MAP_FILE`, with the map's history beside it; another's history and mesh
    are removed. Raises ConfigError or DataError, and writes nothing, where `read_map` could not
    read it.
    """
    path = absolute(path)
    path = path / MAP_FILE if path.is_dir() else path
    field, bounds = finished.field, finished.field.bounds
    if type(field) is not (FORMS.get(field.form) if field.form else FIELDS.get(field.name)):
        raise ConfigError(f"no map file holds a {type(field).__name__}: write what it comes from")
    header = {
        "format_version": _VERSION,
        "field": field.name,
        "form": field.form,
        "bounds": [list(bounds.minimum), list(bounds.maximum)],
        "declared_unit": bounds.declared_unit,
        "camera": asdict(finished.camera),
        "made": finished.record,
    }
    with naming_damaged(path, "map", "mend its field, or give its record what `map_sequence` does"):
        tensors = _tensors(field)
        header["digest"] = digest_of(header, tensors)
        content = safetensors.torch.save(tensors, {_FORMAT: json.dumps(header, allow_nan=False)})
        if _map_of(content, path).key != finished.key:
            raise ValueError("it is read as another map")
    history = finished.history.rename_axis("iteration")
    beside = {HISTORY_FILE: None if history.empty else history.to_csv().encode(), MESH_FILE: None}
    write_together(path.parent, {**(beside if path.name == MAP_FILE else {}), path.name: content})


@usual_modes()
def read_map(path: Path | str) -> Map:
    """A map from the folder that `map` has written, or from a single file, on the CPU.

    A single file comes without a history. Raises MissingError where there is no finished map, and
    DataError where a file is damaged, of another format version, or no map at all; ConfigError
    where its field is not registered.
    """
    path = absolute(path)
    file = path / MAP_FILE if path.is_dir() else path
    history = path / HISTORY_FILE  # a single file has none
    if not file.is_file():
        raise MissingError(f"{path} holds no finished map of this nbtrack: map again, or give one")
    with naming_damaged(file, "map file", _AGAIN):
        # safetensors itself opens no path whose letters are not UTF-8
        stored = _map_of(file.read_bytes(), file)
    if not history.is_file():
        return stored
    with naming_damaged(history, "history", "remove it, or map again"):
        return replace(stored, history=pd.read_csv(history, index_col="iteration"))


def _map_of(content: bytes, file: Path) -> Map:
    """The map of a file's content. Raises ValueError, KeyError and others if it is not sound."""
    tensors = safetensors.torch.load(content)
    # A safetensors file begins with the size of its JSON header, in 8 bytes, and that header.
    size = int.from_bytes(content[:8], "little")
    metadata = json.loads(content[8:][:size])["__metadata__"]
    header = dict(json.loads(metadata[_FORMAT]))
    if header.get("format_version") != _VERSION:
        raise ValueError(f"format {header.get('format_version')!r}; this nbtrack reads {_VERSION}")
    # A bit that flipped on a disk, or a number edited by hand, shows nowhere else.
    if header.pop("digest", None) != digest_of(header, tensors):
        raise ValueError("its content is not what was written")
    name, record = header["field"], header["made"]
    _check_content(header, tensors)
    try:
        low, high = header["bounds"]
        bounds = SceneBounds(low, high, header.get("declared_unit"))
        camera = Intrinsics(**header["camera"])
    except ConfigError as error:
        raise ValueError(error) from None  # so that the file is named
    if name not in FIELDS:
        found = f"{file} is a map of field {name!r}, which is not registered"
        raise ConfigError(f"{found}: import the file of its class first (--import FILE.py)")
    form = header["form"]
    kind = look_up("form of maps", form, FORMS) if form else FIELDS[name]
    return Map(kind.from_state(tensors, record, bounds), camera, record)


def _check_content(header: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    """Raises ValueError or KeyError for content that is not sound, even if its digest fits.

    Names may hold what moves a terminal's cursor, and one NaN among weights spreads to every pose.
    """
    made = header["made"]
    numbers = [made["seconds"], made["misfit_m"], made["seed"], made["n_frames"], *made["origin"]]
    are_numbers = all(type(n) in (int, float) and math.isfinite(n) for n in numbers)
    if not (are_numbers and len(made["origin"]) == 3):
        raise ValueError("a number of its header is missing, not finite, or none")
    if not isinstance(made["scene"], str) or re.search(r"[\x00-\x1f\x7f-\x9f]", made["scene"]):
        raise ValueError("its scene has no name that can be printed")
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise ValueError(f"{name} is not finite")


def _tensors(mapped: Field) -> dict[str, Tensor]:
    """All that was learnt, by name, on the CPU."""
    return {name: part.detach().cpu().contiguous() for name, part in mapped.state().items()}
