"""Finished results in other formats: trajectories, meshes, and maps as one file."""

from collections.abc import Callable
from pathlib import Path

import trimesh

from nbtrack.core.errors import ConfigError, DataError, MissingError, nearest_name
from nbtrack.core.files import write_bytes_atomic
from nbtrack.experiments.cells import METRICS_FILE
from nbtrack.mapping.files import SUMMARY_FILE, StoredMap, read_map, write_map
from nbtrack.mapping.meshes import extract_mesh, write_mesh
from nbtrack.tracking.trajectories import read_tum, write_kitti

MESH_FILE, TRAJECTORY_FILE = "mesh.ply", "trajectory.txt"


def export(source: Path, format_name: str, out: Path) -> str:
    """Write a finished result in another format; an earlier file is replaced.

    Args:
        source: for "tum" and "kitti" the folder of a tracked run, or a trajectory in TUM format;
            for "ply", "glb" and "map" the folder of a map, or a map file.

    Returns:
        What was written, in words.

    Raises:
        ConfigError: the format is unknown, or the file would replace its source.
        MissingError: there is no such result, or it is unfinished.
        DataError: the result is damaged, or is not what the format is for.
    """
    if format_name not in _WRITERS:
        raise ConfigError(f"unknown format {format_name!r}: {nearest_name(format_name, FORMATS)}")
    if source.exists() and out.exists() and source.samefile(out):
        raise ConfigError(f"{out} is the source itself: choose another file to write")
    return _WRITERS[format_name](source, out)


def _write_tum(source: Path, out: Path) -> str:
    path = _trajectory(source)
    n_poses = len(read_tum(path)[0])
    write_bytes_atomic(out, path.read_bytes())
    return f"{n_poses} poses, TUM: timestamp (s), position (m), quaternion xyzw"


def _write_kitti(source: Path, out: Path) -> str:
    T_world_camera = read_tum(_trajectory(source))[1]
    write_kitti(out, T_world_camera)
    return f"{len(T_world_camera)} poses, KITTI: three rows of the matrix (m), no time stamps"


def _write_ply(source: Path, out: Path) -> str:
    return _write_mesh(source, out, "ply")


def _write_glb(source: Path, out: Path) -> str:
    return _write_mesh(source, out, "glb")


def _write_mesh(source: Path, out: Path, file_type: str) -> str:
    stored = _map(source)
    seen = source / MESH_FILE
    if seen.is_file():
        mesh, what = _read_mesh(seen), "what was seen"
    else:
        mesh, what = extract_mesh(stored.field), "the whole surface, the unseen included"
    write_mesh(out, mesh, file_type)
    return f"mesh of {what}: {len(mesh.vertices)} coloured vertices, {len(mesh.faces)} triangles"


def _write_map(source: Path, out: Path) -> str:
    stored = _map(source)
    write_map(out, stored)
    size = out.stat().st_size / 1e6
    return f"{stored.field.label} map of {stored.made['scene']} in one file, {size:.2f} MB"


_WRITERS: dict[str, Callable[[Path, Path], str]] = {
    "tum": _write_tum, "kitti": _write_kitti, "ply": _write_ply, "glb": _write_glb,
    "map": _write_map,
}  # fmt: skip
FORMATS = list(_WRITERS)


def _trajectory(source: Path) -> Path:
    """The trajectory file of a source that is a run's folder or that file itself."""
    if not source.is_dir():
        return source
    if not (source / METRICS_FILE).is_file():
        what = "a map, which exports to ply, glb or map" if (source / SUMMARY_FILE).is_file() else (
            "no finished run"
        )  # fmt: skip
        raise MissingError(f"{source} holds {what}: give a folder that `track --out` wrote")
    return source / TRAJECTORY_FILE


def _map(source: Path) -> StoredMap:
    if (source / METRICS_FILE).is_file():
        raise DataError(
            f"{source} is a tracked run, which exports to tum or kitti: give a map's folder or file"
        )
    return read_map(source)


def _read_mesh(path: Path) -> trimesh.Trimesh:
    try:
        mesh = trimesh.load_mesh(path, process=False)
        if not len(mesh.faces):
            raise ValueError("no triangles")
    except Exception as error:  # readers of a damaged mesh stumble in many ways
        raise DataError(
            f"{path} is not a readable mesh ({type(error).__name__}): remove it and map again"
        ) from None
    return mesh
