"""A tracked run as a moving picture: what was observed, what the map shows there, and the path."""

import io
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from nbtrack.core.arrays import Pose, Poses
from nbtrack.core.camera import Intrinsics
from nbtrack.core.errors import DataError
from nbtrack.data.sequence import RgbdSequence
from nbtrack.plots.rooms import draw_cloud
from nbtrack.plots.style import method_colors, new_axes, styled

Surface = trimesh.Trimesh | trimesh.PointCloud
_WIDTH = 240  # pixels of the map's view
_NEAR = 0.1  # m; nearer surfaces are not drawn
_POINT_SIZE = 0.02  # m, of a map of points
_DPI = 72
_RATE_HZ, _GIF_COLORS = 10, 64


@styled
def movie_pictures(
    surface: Surface,
    sequence: RgbdSequence,
    run: pd.DataFrame,
    T_estimated: Poses,
    title: str,
    progress: Callable[[int], object] = lambda done: None,
) -> list[np.ndarray]:
    """A picture of RGB (height, width, 3; uint8) for each frame of a run.

    Left the observed image, in the middle the map's surface seen from the estimated pose, right the
    estimated path so far from above. `run` has the rows of frames.csv of the sequence's frames,
    `T_estimated` their camera-to-world poses (m).
    """
    moving, page = _panels(surface, sequence, T_estimated, title)
    observed, view, path, here, words = moving
    figure, camera = words.figure, _scaled(sequence.intrinsics, _WIDTH)
    canvas, pictures = FigureCanvasAgg(figure), []
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)  # all that stays is drawn once
    for index, error_m in enumerate(run["translation_error_m"]):
        observed.set_data(sequence.color(index))
        view.set_data(view_of(surface, camera, T_estimated[index]))
        places = T_estimated[: index + 1, :3, 3][:, page].T
        path.set_data(*places)
        here.set_data(*places[:, -1:])
        error = "" if np.isnan(error_m) else f", off by {100 * error_m:.1f} cm"
        words.set_text(f"frame {run['frame_id'].iloc[index]}{error}")
        canvas.restore_region(background)
        for artist in moving:
            figure.draw_artist(artist)
        pictures.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
        progress(index + 1)
    return pictures


def _panels(surface: Surface, sequence: RgbdSequence, T_estimated: Poses, title: str) -> tuple:
    """What changes from frame to frame, in panels where all else is drawn; and the page's axes."""
    left, middle, right = new_axes(title, 2.8, 1, 3, width_ratios=[1, 1, 0.9])[0]
    left.figure.set_dpi(_DPI)
    page = draw_cloud(right, cloud_of(surface), {"tracked": T_estimated})
    for line in right.lines:
        line.remove()
    look = {"color": method_colors(["tracked"])["tracked"], "zorder": 3}
    (path,), (here,) = right.plot([], [], **look), right.plot([], [], "o", **look)
    words = right.text(0, 1.03, "", transform=right.transAxes)
    shape = _scaled(sequence.intrinsics, _WIDTH).height, _WIDTH, 3
    moving = [left.imshow(sequence.color(0)), middle.imshow(np.zeros(shape)), path, here, words]
    for axes, label in ((left, "observed"), (middle, "the map from the estimated pose")):
        axes.set_title(label)
        axes.axis("off")
    for artist in moving:
        artist.set_animated(True)
    return moving, page


def view_of(surface: Surface, camera: Intrinsics, T_world_camera: Pose) -> np.ndarray:
    """The surface (m, world frame) as a camera sees it, (height, width, 3; uint8); white elsewhere.

    Faces are painted from the farthest to the nearest; those that show their back are left out of
    no picture, since the fields differ in the side that they call the front.
    """
    rotation, position = T_world_camera[:3, :3], T_world_camera[:3, 3]
    points = (np.asarray(surface.vertices) - position) @ rotation
    depth = np.maximum(points[:, 2], 1e-6)
    columns = camera.fx * points[:, 0] / depth + camera.cx
    rows = camera.fy * points[:, 1] / depth + camera.cy
    pixels = np.stack([columns, rows], axis=1)
    image = np.full((camera.height, camera.width, 3), 255, np.uint8)
    is_mesh = isinstance(surface, trimesh.Trimesh)
    parts = np.asarray(surface.faces) if is_mesh else np.arange(len(points))[:, None]
    corners, size = pixels[parts], (camera.width, camera.height)
    is_seen = (points[parts, 2] > _NEAR).all(axis=1)
    is_seen &= ((corners.max(axis=1) > 0) & (corners.min(axis=1) < size)).all(axis=1)
    seen = np.flatnonzero(is_seen)
    seen = seen[np.argsort(-points[parts[seen], 2].mean(axis=1))]
    colors = cloud_of(surface)[["red", "green", "blue"]].to_numpy()[parts[seen]].mean(axis=1)
    radii = np.maximum(1, camera.fx * _POINT_SIZE / depth).astype(int)
    for part, color in zip(seen, colors.tolist(), strict=True):
        if is_mesh:
            cv2.fillConvexPoly(image, np.rint(corners[part]).astype(np.int32), color)
        else:
            cv2.circle(
                image, np.rint(corners[part, 0]).astype(int).tolist(), radii[part], color, -1
            )
    return image


def cloud_of(surface: Surface) -> pd.DataFrame:
    """Vertices or points: x, y, z (m, world frame), red, green, blue (0 to 255)."""
    is_mesh = isinstance(surface, trimesh.Trimesh)
    colors = np.asarray(surface.visual.vertex_colors if is_mesh else surface.colors)
    cloud = pd.DataFrame(surface.vertices, columns=["x", "y", "z"])
    cloud[["red", "green", "blue"]] = colors[:, :3]
    return cloud


def movie_bytes(pictures: Sequence[np.ndarray], format_name: str) -> bytes:
    """A GIF that repeats, or an MP4. Raises DataError where OpenCV cannot write the latter."""
    if format_name == "gif":
        images = [Image.fromarray(picture).quantize(_GIF_COLORS) for picture in pictures]
        content, options = io.BytesIO(), {"duration": 1000 // _RATE_HZ, "loop": 0, "optimize": True}
        images[0].save(content, "GIF", save_all=True, append_images=images[1:], **options)
        return content.getvalue()
    with tempfile.TemporaryDirectory() as folder:
        path, size = Path(folder) / "movie.mp4", pictures[0].shape[1::-1]
        movie = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), _RATE_HZ, size)
        if not movie.isOpened():
            raise DataError("OpenCV cannot write MP4 here: export to gif instead")
        for picture in pictures:
            movie.write(picture[..., ::-1])
        movie.release()
        return path.read_bytes()


def _scaled(camera: Intrinsics, width: int) -> Intrinsics:
    """The same camera with another number of pixels."""
    factor = width / camera.width
    lengths = {name: factor * getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
    return replace(camera, width=width, height=round(factor * camera.height), **lengths)
