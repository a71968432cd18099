"""A tracked run as a recording of the Rerun viewer, with all its frames on a time line."""

import numpy as np
import trimesh

from nbtrack.data.sequence import RgbdSequence
from nbtrack.plots.meshes import Mesh
from nbtrack.tracking import Trajectory


def rerun_bytes(surface: Mesh, seen: RgbdSequence, run: Trajectory, title: str) -> bytes:
    """An `.rrd` file of a map's surface, and of a run's paths, frames, errors and verdicts.

    All are relative to the run's origin, by which the file moves them into the recording's world:
    the viewer's numbers have single precision.

    `seen` has some of the run's frames, at the poses (m) where the camera was estimated to be. In
    the viewer frames and seconds are time lines, and errors (m) and verdicts (1: lost) are curves.
    """
    import rerun as rr  # an extra, and slow to load

    recording = rr.RecordingStream(f"nbtrack: {title}")
    stream = recording.binary_stream()
    recording.log("world", rr.Transform3D(translation=run.metrics["origin"]), static=True)
    points, colors = surface.vertices, surface.visual.vertex_colors
    shape = rr.Points3D(points, colors=colors)
    if isinstance(surface, trimesh.Trimesh):
        parts = {"triangle_indices": surface.faces, "vertex_colors": colors}
        shape = rr.Mesh3D(vertex_positions=points, **parts)
    recording.log("world/map", shape, static=True)
    for name, poses in (("tracked", run.T_estimated), ("true", run.T_true)):
        places = poses[np.isfinite(poses).all(axis=(1, 2)), :3, 3]
        recording.log(f"world/{name}", rr.LineStrips3D([places]), static=True)
    camera = seen.intrinsics
    matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    lens = rr.Pinhole(image_from_camera=matrix, resolution=[camera.width, camera.height])
    recording.log("world/camera", lens, static=True)
    for row in run.frames.itertuples():
        recording.set_time("frame", sequence=row.frame_id)
        recording.set_time("seconds", duration=row.time)
        for i in np.flatnonzero(seen.frame_ids == row.frame_id):  # one or none
            T = seen.T_world_camera[i]
            recording.log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
            recording.log("world/camera/color", rr.Image(seen.colors[i]).compress())
            recording.log("world/camera/depth", rr.DepthImage(seen.depths_mm[i], meter=1000))
        recording.log("error_m", rr.Scalars(row.translation_error_m))
        # Of a tracker that does not judge itself, frames without depth are the lost ones.
        recording.log("lost", rr.Scalars(float(getattr(row, "lost", row.without_depth))))
    return stream.read()
