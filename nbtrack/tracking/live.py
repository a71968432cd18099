"""Tracking as a library: images of a running camera in, poses out."""

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8, UInt16

from nbtrack.core.camera import Intrinsics
from nbtrack.core.config import PRESETS, TrackingConfig
from nbtrack.core.errors import ConfigError, DataError
from nbtrack.data.pixels import PixelSampler
from nbtrack.data.sequence import MILLIMETRE, RgbdSequence
from nbtrack.experiments.cells import check_pair, make_budget
from nbtrack.fields import FIELDS, Field
from nbtrack.fields.grid import BakedField, bake_field
from nbtrack.tracking.frame_search import FrameSearch, tracking_threads
from nbtrack.tracking.trackers import tracker_class

# Floating-point depths are metres; an image most of which lies beyond this is none (our choice).
_FARTHEST = 100.0
_MOST_MILLIMETRES = np.iinfo(np.uint16).max


@dataclass(frozen=True)
class TrackedFrame:
    """One frame's pose, and what there is to say about it."""

    T_world_camera: Float[np.ndarray, "4 4"]  # camera to world, m, OpenCV camera axes; never NaN
    # The pose is not to be relied on. `lm` and `icp` judge by their residuals; `vr` and `sdf` have
    # no verdict of their own and only say so of frames without any depth.
    lost: bool
    steps: int
    seconds: float
    report: dict[str, float | bool]  # the tracker's own figures, such as `inlier_ratio`


class LiveTracker:
    """Follows a camera through a known field, one frame a call.

    A recorded sequence fed through it gives the same poses as `track_sequence`, byte for byte:
    both share `FrameSearch`.
    """

    def __init__(
        self,
        field: Field,
        camera: Intrinsics,
        T_world_camera: Float[np.ndarray, "4 4"],
        tracker: str = "lm",
        steps: float | int | None = None,
        rate_hz: float | int | None = None,
        config: TrackingConfig | None = None,
        seed: int = 0,
    ) -> None:
        """
        Args:
            field: a map, as `nbtrack.mapping.files.read_map` gives it; where it lies is computed.
            T_world_camera: where the camera is before the first frame (m, OpenCV camera axes).
            steps, rate_hz: the budget of a frame, one of the two: steps, or 1/rate seconds by the
                clock. By default 20 steps, more than `lm` usually takes (our choice).
            config: the tracker's settings; by default those of the `paper` preset.

        Raises:
            ConfigError: tracker, field and settings do not go together, or there are two budgets.
            DataError: the pose is no rigid transform.
        """
        if steps is not None and rate_hz is not None:
            raise ConfigError("a frame has one budget: give steps or rate_hz, not both")
        config = config or PRESETS["paper"].tracking_of(tracker)
        field = _field_to_ask(field, tracker, config)
        parts = itertools.chain(field.parameters(), field.buffers())
        device = next(parts, torch.empty(0)).device
        self.camera, self.n_frames = camera, 0
        blank = _one_frame(camera, np.zeros((camera.height, camera.width, 3), np.uint8),
                           np.zeros((camera.height, camera.width), np.uint16))  # fmt: skip
        budget = make_budget(20 if steps is None and rate_hz is None else steps, rate_hz, device)
        self.search = FrameSearch(
            tracker, field, PixelSampler(blank, device), budget, config, seed,
            _rigid(T_world_camera),
        )  # fmt: skip
        self.field = field

    def track(
        self,
        color: Shaped[np.ndarray, "..."],
        depth: Shaped[np.ndarray, "..."],
    ) -> TrackedFrame:
        """The camera's pose at the next frame.

        A frame that shows nothing usable keeps the pose that the motion model expects and is
        flagged; the next one goes on from there.

        Args:
            color: RGB, (height, width, 3): uint8, or floating point in [0, 1].
            depth: z-depth along the optical axis, (height, width): uint16 in millimetres, or
                floating point in metres, kept to the millimetre. 0, NaN, infinite and negative ones
                are none; nor are those whose colour is not finite.

        Raises:
            DataError: an image has another size, type or unit.
        """
        frame = _one_frame(self.camera, color, depth)
        self.search.sampler.show(frame)
        with tracking_threads(self.field):
            found = self.search.find(0, f"live frame {self.n_frames}")
        self.n_frames += 1
        return TrackedFrame(
            found.T_world_camera, found.is_lost, found.steps, found.seconds, found.report
        )

    def restart(self, T_world_camera: Float[np.ndarray, "4 4"]) -> None:
        """Go on from another pose (m), as after an interruption; velocities are forgotten.

        Raises:
            DataError: the pose is no rigid transform.
        """
        self.search.estimates = [_rigid(T_world_camera)]

    @property
    def T_world_camera(self) -> Float[np.ndarray, "frames 4 4"]:
        """All poses since the start or the last restart, which comes first."""
        return np.stack(self.search.estimates)


def _field_to_ask(field: Field, tracker_name: str, config: TrackingConfig) -> Field:
    """The field, or its copy on a grid; refused where the tracker cannot work on it."""
    is_baked = isinstance(field, BakedField)
    if is_baked and tracker_class(tracker_name).renders:
        raise ConfigError(f"tracker {tracker_name!r} renders, which a baked field cannot")
    if not is_baked and field.name in FIELDS:  # one that is not registered is its owner's affair
        check_pair(tracker_name, field.name, config.bake_voxel)
    field.eval().requires_grad_(False)
    return bake_field(field, config.bake_voxel) if config.bake_voxel and not is_baked else field


def _one_frame(
    camera: Intrinsics, color: Shaped[np.ndarray, "..."], depth: Shaped[np.ndarray, "..."]
) -> RgbdSequence:
    """A sequence of one frame, whose pose nobody asks for."""
    size = (camera.height, camera.width)
    for name, image, shape in (("color", color, (*size, 3)), ("depth", depth, size)):
        if image.shape != shape:
            raise DataError(
                f"{name} is of shape {image.shape}, but the camera has {shape}: resize the image, "
                "or give the camera that took it"
            )
    color_255, is_usable = _bytes(color)
    depth_mm = np.where(is_usable, _millimetres(depth), np.uint16(0))
    return RgbdSequence(
        "live", camera, color_255[None], depth_mm[None], np.eye(4)[None], np.arange(1)
    )


def _bytes(
    color: Shaped[np.ndarray, "h w 3"],
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Colours as bytes, and where they are known."""
    if color.dtype == np.uint8:
        # Read-only memory is copied: torch does not take it.
        return np.require(color, requirements="CW"), np.ones(color.shape[:2], bool)
    if not np.issubdtype(color.dtype, np.floating):
        raise DataError(f"color is {color.dtype}: give uint8, or floating point in [0, 1]")
    is_known = np.isfinite(color).all(axis=-1)
    known = np.where(is_known[..., None], color, 0)
    if known.max(initial=0) > 1.5:
        raise DataError(
            f"color goes up to {known.max():.4g}: floating point is in [0, 1]; give uint8 instead"
        )
    return (255 * known.clip(0, 1)).round().astype(np.uint8), is_known


def _millimetres(depth: Shaped[np.ndarray, "h w"]) -> UInt16[np.ndarray, "h w"]:
    """Depths in whole millimetres, 0 where there is none."""
    if depth.dtype == np.uint16:
        return depth
    if not np.issubdtype(depth.dtype, np.floating):
        raise DataError(
            f"depth is {depth.dtype}: give uint16 in millimetres, or floating point in metres"
        )
    metres = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float64)
    measured = metres[metres > 0]
    if measured.size and np.median(measured) > _FARTHEST:
        raise DataError(
            f"half of the depths are beyond {np.median(measured):.4g} m: floating point is in "
            "metres; give uint16 if these are millimetres"
        )
    millimetres = (metres / MILLIMETRE).round()
    return np.where(millimetres > _MOST_MILLIMETRES, 0, millimetres).astype(np.uint16)


def _rigid(T_world_camera: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The pose in double precision, if it is one."""
    pose = np.array(T_world_camera, dtype=np.float64)
    rotation = pose[:3, :3]
    is_rigid = np.isfinite(pose).all() and np.allclose(pose[3], (0, 0, 0, 1))
    is_rigid = is_rigid and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-2)
    if not is_rigid or np.linalg.det(rotation) < 0:
        raise DataError(
            f"T_world_camera {pose.round(3).tolist()} is no rigid transform: give the camera's "
            "rotation and position in the world as [R t; 0 0 0 1]"
        )
    return pose
