"""What a camera sees of a room: exact pictures, and those of a structured-light depth camera."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import map_coordinates

from nbtrack.core.arrays import ColorImage, Pose
from nbtrack.core.camera import Intrinsics
from nbtrack.synthetic.room import Room

Depth = Float[np.ndarray, "h w"]
Surfaces = Int[np.ndarray, "h w"]
# Samples of a refined pixel, as offsets from its center in pixels: a 2x2 grid.
_SUBPIXELS = [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)]
BASELINE = 0.075  # m between projector and camera (Khoshelham & Elberink 2012, Kinect v1)
# Pixels (px) are those of an image 640 wide.
DISPARITY_STEP = 1 / 8  # px; the sensor's sub-pixel resolution (the same source)
DISPARITY_NOISE = 1 / 16  # px; std of the random error, half a step (the same source)
LATERAL_NOISE = 0.5  # px; std of the shift of lookups, as in Handa et al. 2014 (ICL-NUIM)
RANGE = (0.4, 8.0)  # m; other depths are invalid (our choice, near the sensor's limits)
# Pixels seen at a larger angle from the normal are lost: noise explodes there (Nguyen et al. 2012).
MAX_INCIDENCE = np.radians(82.0)
EDGE_JUMP = 1.0  # px of disparity; a sharper bend is a depth edge (our choice)


def render_frame(
    room: Room, intrinsics: Intrinsics, T_world_camera: Pose
) -> tuple[ColorImage, Depth, Surfaces]:
    """Color (RGB), z-depth (m, float64, at pixel centers) and surface index of each pixel.

    The index is that of `Room.parts`. At the outline of a surface or in a steep pattern a pixel's
    color is the mean of four samples. Depth is never averaged: a mean over an edge would be a point
    in mid-air. The pose has OpenCV axes; the camera must be in free space.
    """
    height, width = intrinsics.height, intrinsics.width
    rows, columns = np.indices((height, width)).reshape(2, -1)

    def cast(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
        """z-depth (m), color and surface index at pixel columns u and rows v (real numbers)."""
        # `camera.pixel_directions` is single precision, too coarse for an exact depth.
        x = (u + 0.5 - intrinsics.cx) / intrinsics.fx
        y = (v + 0.5 - intrinsics.cy) / intrinsics.fy
        directions_camera = np.stack([x, y, np.ones_like(x)], axis=1)
        return room.cast(T_world_camera[:3, 3], directions_camera @ T_world_camera[:3, :3].T)

    depth, colors, index = cast(columns, rows)
    surfaces = index.reshape(height, width)
    rough = np.flatnonzero(_rough(colors.reshape(height, width, 3), surfaces))
    # One call casts all samples, since culling and shading have a cost per call.
    dx, dy = np.array(_SUBPIXELS).T[:, :, None]  # (4, 1): four samples of each rough pixel
    _, samples, _ = cast((columns[rough] + dx).ravel(), (rows[rough] + dy).ravel())
    colors[rough] = samples.reshape(4, -1, 3).mean(axis=0)
    pixels = np.round(255.0 * colors).astype(np.uint8)
    return pixels.reshape(height, width, 3), depth.reshape(height, width), surfaces


def _rough(image: Float[np.ndarray, "h w 3"], surfaces: Surfaces) -> Bool[np.ndarray, "h w"]:
    """Whether a pixel differs from a neighbor in surface, or in color by over 0.06 (our choice)."""
    looks = np.dstack([image, surfaces])  # indices of two surfaces differ by 1 or more, also > 0.06
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))  # a pixel and its neighbors
    to_largest = cv2.dilate(looks, cross) - looks
    to_smallest = looks - cv2.erode(looks, cross)
    return np.maximum(to_largest, to_smallest).max(axis=2) > 0.06


def add_kinect_noise(depth: Depth, focal: float, rng: np.random.Generator) -> Depth:
    """Depth (m, 0 = invalid) as a Kinect-like sensor would report it.

    Each pixel looks up the depth at a place shifted by random noise. Its disparity gets Gaussian
    noise and is rounded to an eighth of a pixel; this makes depth steps and errors grow with the
    square of depth (2.7 cm steps at 3 m). Pixels at grazing incidence and out of range are lost,
    and most of those at depth edges. Where the exact depth is 0 or not finite nothing is seen.
    Constants in pixels are given for a width of 640, and scaled to that of this image. `focal`
    (pixels) is that of this image. The number of draws from `rng` depends on the image's size only.

    Source: Khoshelham & Elberink, Sensors 2012 (disparity model); Nguyen et al., 3DIMPVT 2012
    (growth with incidence); Handa et al., ICRA 2014 (jitter, rounding). Dropout probability and
    thresholds are our choice.
    """
    per_pixel = 640.0 / depth.shape[1]
    scale = focal * per_pixel * BASELINE  # disparity (px at width 640) times depth (m)
    seen = np.isfinite(depth) & (depth > 0)
    exact = np.where(seen, scale / np.where(seen, depth, 1.0), 0.0)  # disparity (px), 0 if unseen
    lost = ~seen | _is_grazing(exact, focal)
    # On a plane of any slant disparity is affine in pixel coordinates, and its second difference is
    # 0. So a large second difference is an edge.
    bends = [np.abs(np.diff(exact, 2, axis=axis)) > EDGE_JUMP for axis in (0, 1)]
    is_edge = np.pad(bends[0], ((1, 1), (0, 0))) | np.pad(bends[1], ((0, 0), (1, 1)))
    lost |= is_edge & (rng.uniform(size=depth.shape) < 0.6)  # 60 % of edge pixels (our choice)
    shift = rng.normal(scale=LATERAL_NOISE / per_pixel, size=(2, *depth.shape))
    places = np.indices(depth.shape) + shift
    # Lookups interpolate: at a width of 96 the shift is below a tenth of a pixel, and would hardly
    # ever change which pixel is the nearest.
    looked_up = map_coordinates(exact, places, order=1, mode="nearest")
    share_seen = map_coordinates(seen.astype(float), places, order=1, mode="nearest")
    noisy_disparity = looked_up + rng.normal(scale=DISPARITY_NOISE, size=depth.shape)
    disparity = np.rint(noisy_disparity / DISPARITY_STEP) * DISPARITY_STEP
    noisy_depth = scale / np.maximum(disparity, DISPARITY_STEP)
    # The last condition is a lookup that interpolates with a pixel that sees nothing.
    lost |= (noisy_depth < RANGE[0]) | (noisy_depth > RANGE[1]) | (share_seen < 0.999)
    return np.where(lost, 0.0, noisy_depth)


def _is_grazing(disparity: Depth, focal: float) -> Bool[np.ndarray, "h w"]:
    """Whether a pixel sees its surface at more than `MAX_INCIDENCE` from the surface's normal.

    On a plane the disparity at normalised coordinates (x, y) is a x + b y + c, and (a, b, c) is
    parallel to the plane's normal. So the dot product of (a, b, c) and the ray (x, y, 1) is the
    disparity. `focal` is in pixels of this image; the principal point is the image's middle.
    """
    height, width = disparity.shape
    gradient_y = focal * _smaller_difference(disparity)
    gradient_x = focal * _smaller_difference(disparity.T).T
    y = ((np.arange(height) + 0.5 - height / 2) / focal)[:, None]
    x = ((np.arange(width) + 0.5 - width / 2) / focal)[None, :]
    constant = disparity - gradient_x * x - gradient_y * y
    length = np.sqrt(gradient_x**2 + gradient_y**2 + constant**2)  # of (a, b, c)
    cosine = disparity / np.maximum(length * np.sqrt(1 + x * x + y * y), 1e-12)
    return cosine < np.cos(MAX_INCIDENCE)


def _smaller_difference(values: Depth) -> Depth:
    """The difference to the next row or from the previous one, whichever has the smaller size.

    So the slope of a pixel beside an edge is that of its own surface.
    """
    steps = np.pad(np.diff(values, axis=0), ((1, 1), (0, 0)), mode="edge")
    return np.where(np.abs(steps[1:]) < np.abs(steps[:-1]), steps[1:], steps[:-1])


def filter_depth(depth: Depth, sigma_px: float = 2.0, sigma_range: float = 0.1) -> Depth:
    """Depth (m) after a bilateral filter; invalid pixels (0) stay invalid and influence no other.

    `sigma_px` is the standard deviation in space, in pixels of an image 640 wide; in this image it
    is at least 0.7 pixels, so that small images are smoothed, too. `sigma_range` (m) is that of
    depth differences.

    Source: Neural RGB-D filters its noisy depth with these values; the lower limit is our choice.
    """
    sigma = max(sigma_px * depth.shape[1] / 640.0, 0.7)
    valid = depth > 0
    # An invalid pixel has no weight if its value is far from every real depth. A value of 0 would
    # be near enough to 0.4 m to have some.
    marked = np.where(valid, depth, -10.0 * sigma_range - 1.0).astype(np.float32)
    diameter = 2 * int(np.ceil(2 * sigma)) + 1  # pixels: two standard deviations to either side
    smooth = cv2.bilateralFilter(marked, diameter, sigma_range, sigma)
    return np.where(valid, smooth.astype(np.float64), 0.0)
