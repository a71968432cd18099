"""One picture of a room: exact z-depth at pixel centers, anti-aliased color."""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from nbtrack.core.arrays import Pose
from nbtrack.core.camera import Intrinsics
from nbtrack.synthetic.room import Room

# Samples of a refined pixel, as offsets from its center in pixels: a 2x2 grid.
_SUBPIXELS = [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)]
_CONTRAST = 0.06  # difference of color to a neighbor above which a pixel is refined (our choice)
Color = UInt8[np.ndarray, "h w 3"]
Depth = Float[np.ndarray, "h w"]
Surfaces = Int[np.ndarray, "h w"]


def render_frame(
    room: Room, intrinsics: Intrinsics, T_world_camera: Pose
) -> tuple[Color, Depth, Surfaces]:
    """Color (RGB), z-depth (m, float64, at pixel centers) and surface index of each pixel.

    Pixels at the outline of a surface or in a steep pattern get four color samples instead of
    one. Depth is never averaged: a mean over an edge is a point in mid-air. The pose has OpenCV
    axes; the camera stands in free space.
    """
    height, width = intrinsics.height, intrinsics.width
    rows, columns = (grid.ravel() for grid in np.indices((height, width)))

    def cast(columns: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, ...]:
        # `camera.pixel_directions` is single precision, too coarse for an exact depth.
        x = (columns + 0.5 - intrinsics.cx) / intrinsics.fx
        y = (rows + 0.5 - intrinsics.cy) / intrinsics.fy
        directions_camera = np.stack([x, y, np.ones_like(x)], axis=1)
        return room.cast(T_world_camera[:3, 3], directions_camera @ T_world_camera[:3, :3].T)

    depth, colors, index = cast(columns, rows)
    image, surfaces = colors.reshape(height, width, 3), index.reshape(height, width)
    rough = np.flatnonzero(_rough(image, surfaces))
    # One call for all samples: culling and shading cost per call, not only per ray.
    dx, dy = np.array(_SUBPIXELS).T[:, :, None]
    _, samples, _ = cast((columns[rough] + dx).ravel(), (rows[rough] + dy).ravel())
    colors[rough] = samples.reshape(4, -1, 3).mean(axis=0)
    pixels = np.round(255.0 * image).astype(np.uint8)
    return pixels, depth.reshape(height, width), surfaces


def _rough(image: Float[np.ndarray, "h w 3"], surfaces: Surfaces) -> Bool[np.ndarray, "h w"]:
    """Pixels that differ from a neighbor in surface or color."""
    looks = np.dstack([image, surfaces])  # another surface differs by one or more
    steep = [np.abs(np.diff(looks, axis=axis)).max(axis=2) > _CONTRAST for axis in (0, 1)]
    below, right = np.pad(steep[0], ((1, 1), (0, 0))), np.pad(steep[1], ((0, 0), (1, 1)))
    return below[1:] | below[:-1] | right[:, 1:] | right[:, :-1]
