"""A tracked run as a recording of the Rerun viewer, with all its frames on a time line."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import trimesh

from nbtrack.core.arrays import Poses
from nbtrack.core.errors import MissingError
from nbtrack.data.sequence import RgbdSequence
from nbtrack.plots.meshes import Mesh


def import_rerun() -> object:
    """The package rerun. Raises MissingError, naming the extra, where it is not installed."""
    try:
        import rerun
    except ImportError:
        raise MissingError("--to rrd needs Rerun: pip install 'nbtrack[rerun]'") from None
    return rerun


def rerun_bytes(
    surface: Mesh, seen: RgbdSequence, run: pd.DataFrame, T_paths: dict[str, Poses], title: str
) -> bytes:
    """An `.rrd` file of a map's surface, paths (camera to world, m; NaN if not known) and frames.

    `seen` has some frames, at the poses where the camera was estimated to be; `run` has the rows of
    frames.csv of all. In the viewer frames and seconds are time lines, and errors (m) and verdicts
    (1: lost) are curves over them.
    """
    rr = import_rerun()
    recording = rr.RecordingStream(f"nbtrack: {title}")
    colors = surface.visual.vertex_colors
    if isinstance(surface, trimesh.Trimesh):
        parts = {"triangle_indices": surface.faces, "vertex_colors": colors}
        shape = rr.Mesh3D(vertex_positions=surface.vertices, **parts)
    else:
        shape = rr.Points3D(surface.vertices, colors=colors)
    recording.log("world/map", shape, static=True)
    for name, poses in T_paths.items():
        places = poses[np.isfinite(poses).all(axis=(1, 2)), :3, 3]
        recording.log(f"world/{name}", rr.LineStrips3D([places]), static=True)
    camera = seen.intrinsics
    matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    lens = rr.Pinhole(image_from_camera=matrix, resolution=[camera.width, camera.height])
    recording.log("world/camera", lens, static=True)
    for row in run.itertuples():
        recording.set_time("frame", sequence=row.frame_id)
        recording.set_time("seconds", duration=row.time)
        for i in np.flatnonzero(seen.frame_ids == row.frame_id):
            T = seen.T_world_camera[i]
            recording.log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
            recording.log("world/camera/color", rr.Image(seen.colors[i]).compress())
            recording.log("world/camera/depth", rr.DepthImage(seen.depths_mm[i], meter=1000))
        recording.log("error_m", rr.Scalars(row.translation_error_m))
        recording.log("lost", rr.Scalars(float(getattr(row, "lost", row.without_depth))))
    with TemporaryDirectory() as folder:
        recording.save(path := Path(folder, "run.rrd"))
        recording.disconnect()
        return path.read_bytes()
