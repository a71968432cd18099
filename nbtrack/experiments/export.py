"""Finished results in other formats: trajectories, meshes, and maps as one file."""

from pathlib import Path

import trimesh

from nbtrack.core.errors import ConfigError, MissingError, nearest_name
from nbtrack.core.files import naming_damaged, write_atomic
from nbtrack.experiments.runs import METRICS_FILE
from nbtrack.fields import PointCloud
from nbtrack.mapping.files import MAP_FILE, MESH_FILE, read_map
from nbtrack.mapping.meshes import extract_mesh
from nbtrack.tracking.trajectories import read_tum, write_kitti

FORMATS = ["tum", "kitti", "ply", "glb", "map"]


def export(source: Path, format_name: str, out: Path) -> str:
    """Write a run's trajectory, or a map (of folders or files), in another format; says what.

    Raises ConfigError for an unknown format, or a file that would replace its source; MissingError
    and DataError where the result is not there, unfinished, damaged, or not what the format is for.
    """
    if format_name not in FORMATS:
        raise ConfigError(f"unknown format {format_name!r}: {nearest_name(format_name, FORMATS)}")
    if source.exists() and out.exists() and source.samefile(out):
        raise ConfigError(f"{out} is the source itself: choose another file to write")
    if format_name in ("tum", "kitti"):
        return _export_trajectory(source, format_name, out)
    found, seen = read_map(source), source / MESH_FILE
    if format_name == "map":
        content = (source / MAP_FILE if source.is_dir() else source).read_bytes()
        write_atomic(out, content)
        return f"{found.field.label} map of {found.made['scene']}, {len(content) / 1e6:.2f} MB"
    is_seen = seen.is_file() and not isinstance(found.field, PointCloud)
    with naming_damaged(seen, "mesh", "remove it and map again"):
        mesh = trimesh.load_mesh(seen, process=False) if is_seen else extract_mesh(found.field)
        content = mesh.export(file_type=format_name)
    write_atomic(out, content)
    return f"{len(mesh.vertices)} coloured vertices of {'what was seen' if is_seen else 'all'}"


def _export_trajectory(source: Path, format_name: str, out: Path) -> str:
    if source.is_dir() and not (source / METRICS_FILE).is_file():
        raise MissingError(f"{source} holds no finished run: give a folder of `track --out`")
    path = source / "trajectory.txt" if source.is_dir() else source
    T_world_camera = read_tum(path)[1]
    if format_name == "kitti":
        write_kitti(out, T_world_camera)
        return f"{len(T_world_camera)} poses, KITTI: three rows of the matrix (m), no time stamps"
    write_atomic(out, path.read_bytes())
    return f"{len(T_world_camera)} poses, TUM: timestamp (s), position (m), quaternion xyzw"
