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
DISPARITY_STEP = 1 / 8  # px at 640 width: the sensor's sub-pixel resolution (the same source)
DISPARITY_NOISE = 1 / 16  # px at 640 width: half a step of random error (the same source)
LATERAL_NOISE = 0.5  # px at 640 width; Handa et al. 2014 (ICL-NUIM) shift lookups likewise
RANGE = (0.4, 8.0)  # m; nearer and farther is invalid (our choice, near the sensor's limits)
MAX_INCIDENCE = np.radians(82.0)  # dropped beyond; Nguyen et al. 2012: noise explodes there
EDGE_JUMP = 1.0  # px of disparity at 640 width that make a depth edge (our choice)


def render_frame(
    room: Room, intrinsics: Intrinsics, T_world_camera: Pose
) -> tuple[ColorImage, Depth, Surfaces]:
    """Color (RGB), z-depth (m, float64, at pixel centers) and surface index of each pixel.

    Pixels at the outline of a surface or in a steep pattern get four color samples instead of
    one. Depth is never averaged: a mean over an edge is a point in mid-air. The pose has OpenCV
    axes; the camera stands in free space.
    """
    height, width = intrinsics.height, intrinsics.width
    rows, columns = np.indices((height, width)).reshape(2, -1)

    def cast(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
        """z-depth, color and surface at pixel columns u and rows v, which need not be whole."""
        # `camera.pixel_directions` is single precision, too coarse for an exact depth.
        x = (u + 0.5 - intrinsics.cx) / intrinsics.fx
        y = (v + 0.5 - intrinsics.cy) / intrinsics.fy
        directions_camera = np.stack([x, y, np.ones_like(x)], axis=1)
        return room.cast(T_world_camera[:3, 3], directions_camera @ T_world_camera[:3, :3].T)

    depth, colors, index = cast(columns, rows)
    surfaces = index.reshape(height, width)
    rough = np.flatnonzero(_rough(colors.reshape(height, width, 3), surfaces))
    # One call for all samples: culling and shading cost per call, not only per ray.
    dx, dy = np.array(_SUBPIXELS).T[:, :, None]  # (4, 1): four samples of each rough pixel
    _, samples, _ = cast((columns[rough] + dx).ravel(), (rows[rough] + dy).ravel())
    colors[rough] = samples.reshape(4, -1, 3).mean(axis=0)
    pixels = np.round(255.0 * colors).astype(np.uint8)
    return pixels.reshape(height, width, 3), depth.reshape(height, width), surfaces


def _rough(image: Float[np.ndarray, "h w 3"], surfaces: Surfaces) -> Bool[np.ndarray, "h w"]:
    """Pixels that differ from a neighbor in surface, or in color by more than 0.06 (our choice)."""
    looks = np.dstack([image, surfaces])  # another surface differs by one or more
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))  # a pixel and its neighbors
    to_largest = cv2.dilate(looks, cross) - looks
    to_smallest = looks - cv2.erode(looks, cross)
    return np.maximum(to_largest, to_smallest).max(axis=2) > 0.06


def add_kinect_noise(depth: Depth, focal: float, rng: np.random.Generator) -> Depth:
    """Depth (m, 0 = invalid) as a Kinect-like sensor would report it.

    Lookups jitter sideways; disparity gets Gaussian noise and is rounded to an eighth of a pixel,
    which makes depth steps and errors grow with the square of depth (2.7 cm steps at 3 m); pixels
    at depth edges, at grazing incidence and out of range are lost. All pixel constants hold at a
    width of 640; other widths are treated as the same camera's image made smaller. Where the exact
    depth is 0 or not finite nothing is seen. `focal` (pixels) is that of this image; `rng` advances
    by a fixed number of draws.

    Source: Khoshelham & Elberink, Sensors 2012 (disparity model); Nguyen et al., 3DIMPVT 2012
    (growth with incidence); Handa et al., ICRA 2014 (jitter, rounding). Dropout probability and
    thresholds are our choice.
    """
    per_pixel = 640.0 / depth.shape[1]
    scale = focal * per_pixel * BASELINE  # disparity (px at width 640) times depth (m)
    seen = np.isfinite(depth) & (depth > 0)
    exact = np.where(seen, scale / np.where(seen, depth, 1.0), 0.0)
    lost = ~seen | _is_grazing(exact, focal)
    # On planes, however slanted, disparity is affine: where it bends sharply is an edge.
    bends = [np.abs(np.diff(exact, 2, axis=axis)) > EDGE_JUMP for axis in (0, 1)]
    is_edge = np.pad(bends[0], ((1, 1), (0, 0))) | np.pad(bends[1], ((0, 0), (1, 1)))
    lost |= is_edge & (rng.uniform(size=depth.shape) < 0.6)  # (our choice)
    shift = rng.normal(scale=LATERAL_NOISE / per_pixel, size=(2, *depth.shape))
    places = np.indices(depth.shape) + shift
    # Interpolated: at a width of 96 the jitter is below a tenth of a pixel, and the nearest pixel
    # would nearly always be the same one.
    looked_up = map_coordinates(exact, places, order=1, mode="nearest")
    share_seen = map_coordinates(seen.astype(float), places, order=1, mode="nearest")
    noisy = looked_up + rng.normal(scale=DISPARITY_NOISE, size=depth.shape)
    disparity = np.rint(noisy / DISPARITY_STEP) * DISPARITY_STEP
    measured = scale / np.maximum(disparity, DISPARITY_STEP)
    lost |= (measured < RANGE[0]) | (measured > RANGE[1]) | (share_seen < 0.999)
    return np.where(lost, 0.0, measured)


def _is_grazing(disparity: Depth, focal: float) -> Bool[np.ndarray, "h w"]:
    """Pixels whose surface is seen at more than `MAX_INCIDENCE` from its normal.

    On a plane disparity, like inverse depth, is a x + b y + c over normalised coordinates (x, y),
    and (a, b, c) is parallel to the normal; so its product with the ray (x, y, 1) is disparity.
    `focal` is in pixels of this image; the principal point is the image's middle.
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
    """Difference to the next or from the previous row, whichever is less: no slope over an edge."""
    steps = np.pad(np.diff(values, axis=0), ((1, 1), (0, 0)), mode="edge")
    return np.where(np.abs(steps[1:]) < np.abs(steps[:-1]), steps[1:], steps[:-1])


def filter_depth(depth: Depth, sigma_px: float = 2.0, sigma_range: float = 0.1) -> Depth:
    """Bilateral filter of depth (m); invalid pixels (0) stay invalid and influence none.

    Standard deviations are in space (pixels at a width of 640) and of depth differences (m). The
    first shrinks with the image, but not below 0.7 pixels of it: small images are smoothed too.

    Source: Neural RGB-D filters its noisy depth with these values; the lower limit is our choice.
    """
    sigma = max(sigma_px * depth.shape[1] / 640.0, 0.7)
    valid = depth > 0
    # Far from every real depth an invalid pixel has no weight; zero would pull at 0.4 m.
    marked = np.where(valid, depth, -10.0 * sigma_range - 1.0).astype(np.float32)
    diameter = 2 * int(np.ceil(2 * sigma)) + 1  # pixels: two standard deviations to either side
    smooth = cv2.bilateralFilter(marked, diameter, sigma_range, sigma)
    return np.where(valid, smooth.astype(np.float64), 0.0)
