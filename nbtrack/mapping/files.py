"""Maps as files: the folder that mapping writes, and one small file that opens anywhere.

The file holds tensors and plain values only, and is read without running any code that it might
contain. Everything in it is checked: it may come from anybody.
"""

import hashlib
import io
import math
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.core.config import FieldConfig
from nbtrack.core.errors import ConfigError, DataError, MissingError
from nbtrack.core.files import naming_damaged, read_checkpoint, read_json, write_bytes_atomic
from nbtrack.core.provenance import fingerprint
from nbtrack.fields import Field, field_class, make_field
from nbtrack.mapping.fits import MapFit
from nbtrack.mapping.seen_volume import SeenVolume

MAP_FILE, SUMMARY_FILE = "map.pt", "map.json"  # of a folder: weights and checkpoint; the rest
FORMAT, FORMAT_VERSION = "nbtrack map", 1
_ADVICE = "write a new one with `nbtrack export MAP_FOLDER --to map FILE`"
_PARTS = {"field": str, "network": dict, "bounds": list, "camera": dict, "state": dict,
          "made": dict, "seen": dict}  # fmt: skip
_MADE = ("scene", "frames", "seed", "key", "seconds", "device", "versions")
# A network wider than this would take a gigabyte before its weights are even looked at.
_WIDEST = 8192


@dataclass(frozen=True)
class StoredMap:
    """A finished map, ready for tracking, with what is known of how it was made."""

    field: Field
    network: FieldConfig
    camera: Intrinsics  # of the frames it was made from
    # Scene, frames, seed, key, seconds, device and versions; plain values.
    made: dict[str, Any]
    usual_fit: MapFit | None  # how it fits the frames it was made from; None: not at all
    seen: SeenVolume  # where these frames have seen surfaces

    @cached_property
    def key(self) -> str:
        """Twelve hexadecimal digits that change with the field, its bounds and its weights."""
        weights = hashlib.sha256()
        for name, tensor in self.field.state_dict().items():
            weights.update(name.encode() + tensor.cpu().contiguous().numpy().tobytes())
        return fingerprint(
            self.field.name, self.network, asdict(self.field.bounds), weights.hexdigest()
        )


def read_map(path: Path | str) -> StoredMap:
    """A map from the folder that `map` has written, or from a single file, on the CPU.

    Raises:
        MissingError: there is nothing at the path, or no finished map in the folder.
        DataError: the file is damaged, of another format version, or no map at all.
    """
    path = Path(path)
    if path.is_dir():
        return _read_folder(path)
    if not path.is_file():
        raise MissingError(f"no map {path}: give a folder that `map --out` wrote, or a map file")
    content = read_checkpoint(path, "map file", _ADVICE)
    if content.get("format") != FORMAT:
        if {"settings", "field", "iteration"} <= set(content):
            raise DataError(f"{path} is mapping's own checkpoint: give its folder {path.parent}")
        raise DataError(f"{path} is not a map file (no format {FORMAT!r} in it): {_ADVICE}")
    if content.get("format_version") != FORMAT_VERSION:
        raise DataError(
            f"{path} has map format {content.get('format_version')!r}, and this nbtrack reads "
            f"{FORMAT_VERSION}: {_ADVICE} of the same nbtrack"
        )
    with naming_damaged(path, "map file", _ADVICE):
        stored = _opened(content)
        if stored.key != content["key"]:  # a bit that flipped on a disk shows nowhere else
            raise ValueError("its content is not what was written")
    return stored


def write_map(path: Path, stored: StoredMap) -> None:
    """Writes a map as one file, about 1 MB for the paper's network.

    Weights keep every bit, so that tracking in the file gives the trajectory of the map itself.
    """
    bounds = stored.field.bounds
    buffer = io.BytesIO()
    torch.save(
        {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "field": stored.field.name,
            "network": asdict(stored.network),
            "bounds": [list(bounds.minimum), list(bounds.maximum)],
            "camera": asdict(stored.camera),
            "state": {
                name: tensor.cpu().clone() for name, tensor in stored.field.state_dict().items()
            },
            "key": stored.key,
            "made": stored.made,
            "usual_fit": stored.usual_fit and stored.usual_fit.to_dict(),
            "seen": stored.seen.to_dict(),
        },
        buffer,
    )
    write_bytes_atomic(path, buffer.getvalue())


def _read_folder(folder: Path) -> StoredMap:
    if not (folder / SUMMARY_FILE).is_file():
        found = "an unfinished map: run its `map` command again" if (
            folder / MAP_FILE
        ).is_file() else "no map: give a folder that `map --out` wrote"  # fmt: skip
        raise MissingError(f"{folder} holds {found}")
    summary = read_json(folder / SUMMARY_FILE)
    if "seen" not in summary:
        raise DataError(f"{folder} was mapped by an earlier nbtrack: map again into a new folder")
    state = read_checkpoint(folder / MAP_FILE)
    with naming_damaged(folder / MAP_FILE):
        return _opened({
            "field": state["settings"]["field"],
            "network": state["settings"]["field_config"],
            "bounds": [list(corner) for corner in state["bounds"]],
            "camera": summary["camera"],
            "state": state["field"],
            "made": {name: summary[name] for name in _MADE},
            "usual_fit": summary["usual_fit"],
            "seen": summary["seen"],
        })  # fmt: skip


def _opened(content: dict[str, Any]) -> StoredMap:
    """The map that checked content describes. Raises ValueError or another if it is not sound."""
    for name, kind in _PARTS.items():
        if not isinstance(content[name], kind):
            raise ValueError(f"{name} is a {type(content[name]).__name__}")
    _check_numbers(content)
    try:
        field_class(content["field"])
    except ConfigError as error:
        raise DataError(f"the map needs a field that this nbtrack lacks: {error}") from None
    network, camera = FieldConfig(**content["network"]), Intrinsics(**content["camera"])
    low, high = (tuple(map(float, corner)) for corner in content["bounds"])
    stored_field = make_field(content["field"], network, SceneBounds(low, high), seed=0)
    stored_field.load_state_dict(content["state"])
    stored_field.eval().requires_grad_(False)
    # Weights of a wrong shape that loading lets pass would only be met in tracking.
    stored_field(torch.tensor([low, high]).mean(dim=0, keepdim=True))
    made = {name: content["made"][name] for name in _MADE}
    fit = content["usual_fit"]
    return StoredMap(
        stored_field, network, camera, made, fit and MapFit(**fit),
        SeenVolume.from_dict(content["seen"]),
    )  # fmt: skip


def _check_numbers(content: dict[str, Any]) -> None:
    """Raises ValueError for what would build a giant network, or spread NaN later."""
    for name in ("width", "n_frequencies"):
        size = content["network"][name]
        if type(size) is not int or not 1 <= size <= _WIDEST:
            raise ValueError(f"network.{name} is {size!r}")
    bounds = content["bounds"]
    if [len(corner) for corner in bounds] != [3, 3]:
        raise ValueError("bounds are not two corners")
    numbers = [*bounds[0], *bounds[1], *content["camera"].values(), content["made"]["seconds"]]
    if not all(isinstance(n, int | float) and math.isfinite(n) for n in numbers):
        raise ValueError("bounds, camera or seconds are not finite numbers")
    if not all(low < high for low, high in zip(*bounds, strict=True)):
        raise ValueError(f"bounds {bounds} are empty")
    if min(content["camera"][name] for name in ("width", "height", "fx", "fy")) <= 0:
        raise ValueError("the camera has no size")
    if not all(bool(tensor.isfinite().all()) for tensor in content["state"].values()):
        raise ValueError("weights are not finite")
