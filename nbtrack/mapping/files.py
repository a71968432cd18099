"""Finished maps, and their files: safetensors, which run no code and are checked when read."""

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
from nbtrack.machinery.errors import ConfigError, MissingError, look_up, typed
from nbtrack.machinery.files import absolute, digest_of, naming_damaged, write_together
from nbtrack.machinery.registry import Registry

MAP_FILE = "map.safetensors"
HISTORY_FILE = "history.csv"  # losses over iterations
MESH_FILE = "mesh.ply"  # the part of a map's surface that its frames have seen
CHECKPOINT_FILE = "mapping.pt"  # of an unfinished map
_FORMAT = "nbtrack map"
_VERSION = 4
FORMS: Registry[type[Field]] = Registry({})
"""Classes of fields that are made from finished maps, such as corrected ones, by name."""
_AGAIN = "remove it and map again; give the folder or its map.safetensors, of this version"


@typed
@dataclass(frozen=True)
class Map:
    """A mapped scene, ready for tracking, and the record of how it was made."""

    field: Field
    camera: Intrinsics  # of the mapped frames
    # Plain values: what `map_sequence` records (the scene, seed, network, settings, misfit_m, the
    # seconds spent in iterations, ...), and what callers add, such as scores.
    record: dict[str, Any]
    # One row for each iteration: weighted loss terms and diagnostics. Empty if it was not kept.
    history: pd.DataFrame = field(default_factory=pd.DataFrame)

    @property
    def key(self) -> str:
        """A hash of the field, its bounds and its weights, as twelve hexadecimal digits."""
        mapped = self.field
        plain = [mapped.name, mapped.form, self.record["network"], asdict(mapped.bounds)]
        return digest_of(plain, _tensors(mapped))[:12]


@typed
@usual_modes()
def write_map(path: Path | str, finished: Map) -> None:
    """Write a map to a file, of about 1 MB for the paper's network.

    If the path is a folder, the file is its `MAP_FILE`. Beside a file of this name the map's
    history is written, and the history and mesh of an earlier map are removed. Weights keep every
    bit, so that the file gives the same trajectories as the map.

    Nothing is written if `read_map` could not read the file. Then ConfigError is raised for a field
    whose class is not registered, and DataError for a damaged field or record.
    """
    path = absolute(path)
    path = path / MAP_FILE if path.is_dir() else path
    field, bounds = finished.field, finished.field.bounds
    # The file holds only the name by which the field's class is registered. `read_map` looks it up.
    registered = FORMS.get(field.form) if field.form else FIELDS.get(field.name)
    if type(field) is not registered:
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
        # Read the content as a test: this raises for what could not be read from the file either.
        if _map_of(content, path).key != finished.key:
            raise ValueError("it is read as another map, as weights of other than float32 are")
    others = {}
    if path.name == MAP_FILE:  # the folder's other files belong to the map; None removes a file
        history = finished.history.rename_axis("iteration")
        text = None if history.empty else history.to_csv().encode()
        others = {HISTORY_FILE: text, MESH_FILE: None}
    write_together(path.parent, {**others, path.name: content})


@usual_modes()
def read_map(path: Path | str) -> Map:
    """The map, on the CPU, of a folder that the command `map` has written, or of a single file.

    A single file has no history. Raises MissingError if there is no finished map; DataError if a
    file is damaged, of another format version, or no map at all; ConfigError if the map's field is
    not registered.
    """
    path = absolute(path)
    file = path / MAP_FILE if path.is_dir() else path
    history = path / HISTORY_FILE  # below a single file there is none
    if not file.is_file():
        raise MissingError(f"{path} holds no finished map of this nbtrack: map again, or give one")
    with naming_damaged(file, "map file", _AGAIN):
        # The bytes are read here, since safetensors opens no path that is not UTF-8.
        stored = _map_of(file.read_bytes(), file)
    if not history.is_file():
        return stored
    with naming_damaged(history, "history", "remove it"):
        return replace(stored, history=pd.read_csv(history, index_col="iteration"))


def _map_of(content: bytes, file: Path) -> Map:
    """The map of a file's content. `file` is named in errors.

    Raises ConfigError if the map's class is not registered, and ValueError, KeyError or others if
    the content is damaged: callers turn these into one DataError by `naming_damaged`.
    """
    tensors = safetensors.torch.load(content)
    # A safetensors file begins with the size of its JSON header, in 8 bytes, and that header.
    size = int.from_bytes(content[:8], "little")
    metadata = json.loads(content[8:][:size])["__metadata__"]
    header = dict(json.loads(metadata[_FORMAT]))
    if header.get("format_version") != _VERSION:
        raise ValueError(f"format {header.get('format_version')!r}; this nbtrack reads {_VERSION}")
    # Nothing else notices a bit that flipped on a disk, or a number edited by hand.
    if header.pop("digest", None) != digest_of(header, tensors):
        raise ValueError("its content is not what was written")
    name, form, record = header["field"], header["form"], header["made"]
    _check_content(header, tensors)
    try:
        low, high = header["bounds"]
        bounds = SceneBounds(low, high, header.get("declared_unit"))
        camera = Intrinsics(**header["camera"])
    except ConfigError as error:
        raise ValueError(error) from None  # `read_map` adds the file's name to a ValueError
    if name not in FIELDS:
        found = f"{file} is a map of field {name!r}, which is not registered"
        raise ConfigError(f"{found}: import the file of its class first (--import FILE.py)")
    kind = look_up("form of maps", form, FORMS) if form else FIELDS[name]
    return Map(kind.from_state(tensors, record, bounds), camera, record)


def _check_content(header: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    """Raises ValueError or KeyError for content that is wrong although its digest fits.

    A file may come from anybody: a scene's name may hold control characters that act on a
    terminal, and a NaN among the weights would spread to every pose.
    """
    made = header["made"]
    numbers = [made["seconds"], made["misfit_m"], made["seed"], made["n_frames"], *made["origin"]]
    # True and False are of the type bool, and are no numbers here.
    are_numbers = all(type(n) in (int, float) and math.isfinite(n) for n in numbers)
    if not (are_numbers and len(made["origin"]) == 3):
        raise ValueError("a number of its header is missing, not finite, or none")
    if not isinstance(made["scene"], str) or re.search(r"[\x00-\x1f\x7f-\x9f]", made["scene"]):
        raise ValueError("its scene has no name that can be printed")
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise ValueError(f"{name} is not finite")


def _tensors(mapped: Field) -> dict[str, Tensor]:
    """The tensors of a field's `state_dict`, contiguous and on the CPU."""
    return {name: part.cpu().contiguous() for name, part in mapped.state_dict().items()}
