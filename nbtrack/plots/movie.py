"""A tracked run as an animated GIF, or as a recording for the Rerun viewer.

Both show the observed images, the map and the path; the GIF shows the map from the estimated pose.
"""

import io
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pandas as pd
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from nbtrack.core.arrays import Pose, Poses
from nbtrack.core.camera import Intrinsics
from nbtrack.data.sequence import RgbdSequence
from nbtrack.plots.figures import show_image
from nbtrack.plots.meshes import Mesh
from nbtrack.plots.scene import draw_cloud
from nbtrack.plots.style import new_axes, styled
from nbtrack.tracking import Trajectory

_WIDTH = 240  # pixels of the view of the map
_NEAR = 0.1  # m; nearer surfaces are not drawn
# The corners (m) of the square that is drawn for a point. It faces the camera.
_SQUARE = 0.02 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def movie_pictures(
    surface: Mesh,
    sequence: RgbdSequence,
    run: pd.DataFrame,
    T_estimated: Poses,
    title: str,
    progress: Callable[[int], object] = lambda done: None,
) -> Iterator[Image.Image]:
    """Yields a picture for each frame of a run, drawn when it is asked for.

    It shows the observed image on the left, the map's surface from the estimated pose in the
    middle, and the estimated path up to this frame from above on the right. `run` has a row of
    frames.csv for each frame of the sequence; `T_estimated` are their camera-to-world poses (m).
    `progress` is told the number of pictures drawn.
    """
    left, middle, right = new_axes(title, 2.8, 1, 3, width_ratios=[1, 1, 0.9])[0]
    page = draw_cloud(right, cloud_of(surface), {"tracked": T_estimated})
    path, dot = right.lines  # all that `draw_cloud` draws; the dot, at the start, moves along below
    dot.set_color(path.get_color())
    label = right.text(0, 1.03, "", transform=right.transAxes)
    canvas = FigureCanvasAgg(left.figure)
    left.figure.set_dpi(72)
    for index, row in enumerate(run.itertuples()):
        view = view_of(surface, sequence.intrinsics, T_estimated[index])
        left.clear()
        show_image(left, sequence.color(index), "observed")
        middle.clear()
        show_image(middle, view, "the map from the estimated pose")
        places = page @ T_estimated[: index + 1, :3, 3].T
        path.set_data(*places)
        dot.set_data(*places[:, -1:])
        error_cm = 100 * row.translation_error_m
        error = "" if np.isnan(error_cm) else f", off by {error_cm:.1f} cm"
        label.set_text(f"frame {row.frame_id}{error}")
        canvas.draw()
        left.figure.set_layout_engine("none")  # keeps the layout of the first picture
        progress(index + 1)
        # A picture in a GIF has at most 256 colours; 64 keep the file small.
        yield Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).quantize(64)


@styled
def movie_bytes(pictures: Iterator[Image.Image]) -> bytes:
    """The content of a GIF that repeats; there must be at least one picture.

    `movie_pictures` draws each picture when this function asks for it, and so in the house style.
    """
    content = io.BytesIO()
    options = {"duration": 100, "loop": 0, "optimize": True}  # ms a picture
    next(pictures).save(content, "GIF", save_all=True, append_images=pictures, **options)
    return content.getvalue()


def view_of(surface: Mesh, camera: Intrinsics, T_world_camera: Pose) -> np.ndarray:
    """An image (height, `_WIDTH`, 3; uint8) of a surface (m, world frame) from a camera pose.

    Faces, and squares in place of points, are painted from the farthest to the nearest on white.
    Faces that show their back are painted, too, since marching cubes gives densities and distances
    opposite fronts.
    """
    scale = _WIDTH / camera.width
    height = round(scale * camera.height)
    points_camera = (np.asarray(surface.vertices) - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    is_cloud = isinstance(surface, trimesh.PointCloud)
    # Each part is a polygon: a face with the indices of its corners, or a point with its own.
    parts = np.arange(len(points_camera))[:, None] if is_cloud else surface.faces
    corners = points_camera[parts] + (_SQUARE if is_cloud else 0)
    depth = np.maximum(corners[..., 2:], _NEAR)  # avoids a division by 0 in parts left out below
    pixels = scale * (corners[..., :2] / depth * [camera.fx, camera.fy] + [camera.cx, camera.cy])
    in_view = ((pixels.max(axis=1) > 0) & (pixels.min(axis=1) < [_WIDTH, height])).all(axis=1)
    seen = np.flatnonzero(in_view & (corners[..., 2] > _NEAR).all(axis=1))
    order = seen[np.argsort(-corners[seen, :, 2].mean(axis=1))]  # from the farthest to the nearest
    colors = surface.visual.vertex_colors[parts[order], :3].mean(axis=1)
    image = np.full((height, _WIDTH, 3), 255, np.uint8)
    for polygon, color in zip(pixels[order].round().astype(np.int32), colors.tolist(), strict=True):
        cv2.fillConvexPoly(image, polygon, color)
    return image


def cloud_of(surface: Mesh) -> pd.DataFrame:
    """A row for each vertex or point: x, y, z (m, world frame), red, green, blue (0 to 255)."""
    cloud = pd.DataFrame(surface.vertices, columns=["x", "y", "z"])
    cloud[["red", "green", "blue"]] = surface.visual.vertex_colors[:, :3]
    return cloud


def rerun_bytes(surface: Mesh, seen: RgbdSequence, run: Trajectory, title: str) -> bytes:
    """The content of an `.rrd` file: a map's surface, and a run's paths, frames, errors, verdicts.

    `seen` holds some of the run's frames with their estimated poses (m). In the viewer, frame
    numbers and seconds are time lines; errors (m) and verdicts (1: lost) are curves.

    The viewer has single precision. So all positions are stored relative to the run's origin, and a
    transform moves them into the recording's world.
    """
    import rerun as rr  # an optional package, which is slow to load

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
    index_of = {frame_id: index for index, frame_id in enumerate(seen.frame_ids.tolist())}
    for row in run.frames.itertuples():
        recording.set_time("frame", sequence=row.frame_id)
        recording.set_time("seconds", duration=row.time)
        if (i := index_of.get(row.frame_id)) is not None:
            T = seen.T_world_camera[i]
            recording.log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
            recording.log("world/camera/color", rr.Image(seen.colors[i]).compress())
            recording.log("world/camera/depth", rr.DepthImage(seen.depths_mm[i], meter=1000))
        recording.log("error_m", rr.Scalars(row.translation_error_m))
        # If the tracker does not judge its estimates, frames without depth count as lost.
        recording.log("lost", rr.Scalars(float(getattr(row, "lost", row.without_depth))))
    return stream.read()
