"""One pass over a recording: counts of all its frames, pixels of a few."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float, Int, UInt8, UInt16
from tqdm.auto import tqdm

from nbtrack.core.camera import Intrinsics
from nbtrack.core.errors import DataError
from nbtrack.data.readers import Recording, decode, ray_lengths

_FRAMES_AT_ONCE = 32  # read at a time: 50 MB at 640x480
_SPREAD_FRAMES = 60  # over the sequence, for its bounds; with the pairs at most 60 MB
_N_PAIRS = 20
_GAPS = (5, 10, 15)  # frames between the two of a pair: they moved, and still see the same
_POINTS_PER_FRAME = 3000  # of the cloud: 300,000 in all


@dataclass(frozen=True, eq=False)
class Cloud:
    """Coloured points of some frames, as the declared reading places them."""

    points_world: Float[np.ndarray, "points 3"]  # m
    colors: UInt8[np.ndarray, "points 3"]  # RGB
    frames: Int[np.ndarray, "points"]  # which of the kept frames saw each

    def seen_share(self, cell: float = 0.1, by_frames: int = 3) -> float:
        """Share of the surface's cells (edge in m) that so many of the kept frames saw."""
        cells = np.floor(self.points_world / cell).astype(np.int64)
        sightings = pd.DataFrame(cells, columns=list("xyz")).assign(frame=self.frames)
        counts = sightings.drop_duplicates().groupby(list("xyz")).size().to_numpy()
        needed = min(by_frames, len(np.unique(self.frames)))
        return float((counts >= needed).mean()) if len(counts) else 0.0


@dataclass(frozen=True, eq=False)
class Scan:
    """What one pass over the frames with a pose finds."""

    intrinsics: Intrinsics
    frame_ids: Int[np.ndarray, "frames"]
    depth_counts: Int[np.ndarray, "65536"]  # pixels by depth value, as in the files
    measured: Float[np.ndarray, "frames"]  # share of the pixels
    brightness: Float[np.ndarray, "frames"]  # mean, 0 to 1
    kept_ids: Int[np.ndarray, "kept"]  # frames whose pixels follow
    kept_depths: UInt16[np.ndarray, "kept height width"]  # as in the files
    kept_colors: UInt8[np.ndarray, "kept rows columns 3"]  # every `stride`-th pixel
    stride: int

    @property
    def pairs(self) -> Int[np.ndarray, "pairs 2"]:
        """Pairs of the kept frames that see much the same."""
        return np.searchsorted(self.kept_ids, self.frame_ids[_pairs(len(self.frame_ids))])

    def cloud(self, recording: Recording) -> Cloud:
        """Points of the kept frames in the world, with their colours."""
        stride, camera, declared = self.stride, self.intrinsics, recording.declared
        lengths = ray_lengths(camera) if declared.depth_along == "ray" else np.ones((1, 1))
        values_per_metre = declared.depth_scale * lengths[::stride, ::stride]
        depth = self.kept_depths[:, ::stride, ::stride] / values_per_metre
        kept, rows, columns = np.nonzero(depth)
        z = depth[kept, rows, columns]
        x = (columns * stride + 0.5 - camera.cx) / camera.fx
        y = (rows * stride + 0.5 - camera.cy) / camera.fy
        T = recording.T_world_camera[self.kept_ids][kept]
        points = np.einsum("nij,nj->ni", T[:, :3, :3], np.stack([x * z, y * z, z], axis=1))
        return Cloud(points + T[:, :3, 3], self.kept_colors[kept, rows, columns], kept)


def scan_recording(recording: Recording, progress: bool = False) -> Scan:
    """Read every frame that has a pose, a few at a time.

    At 640x480 that takes 0.3 GB, however long the recording is.

    Raises:
        DataError, MissingError: as `decode` does; no frame has a pose, or sizes differ.
    """
    frame_ids = np.flatnonzero(recording.has_pose)
    if len(frame_ids) == 0:
        raise DataError(
            f"all {len(recording)} poses in {recording.pose_file} are NaN: at least one frame "
            "needs a pose; choose another pose file"
        )
    wanted = frame_ids[_kept_positions(len(frame_ids))]
    counts = np.zeros(1 << 16, np.int64)
    measured, brightness, depths, colors = [], [], [], []
    first: Intrinsics | None = None
    starts = range(0, len(frame_ids), _FRAMES_AT_ONCE)
    stretches = tqdm(starts, "checking", unit="stretch", disable=not progress, delay=1.0)
    for start in stretches:
        part = frame_ids[start : start + _FRAMES_AT_ONCE]
        decoded = decode(recording, part, as_in_files=True)
        first = first or decoded.intrinsics
        if decoded.intrinsics != first:
            raise DataError(
                f"{recording.color_files[part[0]]} is {decoded.intrinsics.width}x"
                f"{decoded.intrinsics.height} but {recording.color_files[frame_ids[0]]} is "
                f"{first.width}x{first.height}: all images and depth maps need one size; resize "
                "them first"
            )
        stride = max(1, round((first.width * first.height / _POINTS_PER_FRAME) ** 0.5))
        counts += np.bincount(decoded.depths.ravel(), minlength=1 << 16)
        measured.append((decoded.depths > 0).mean(axis=(1, 2)))
        brightness.append(decoded.colors.mean(axis=(1, 2, 3)) / 255)
        kept = np.isin(part, wanted)
        depths.append(decoded.depths[kept])
        colors.append(decoded.colors[kept, ::stride, ::stride])
    return Scan(
        first, frame_ids, counts, np.concatenate(measured), np.concatenate(brightness), wanted,
        np.concatenate(depths), np.concatenate(colors), stride,
    )  # fmt: skip


def _pairs(n_frames: int) -> Int[np.ndarray, "pairs 2"]:
    """Positions of frame pairs, spread over the sequence, with all gaps alike."""
    pairs = set()
    for i in range(_N_PAIRS):
        gap = min(_GAPS[i % len(_GAPS)], n_frames - 1)
        first = round((n_frames - 1 - gap) * i / (_N_PAIRS - 1))
        pairs |= {(first, first + gap)} if gap > 0 else set()
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def _kept_positions(n_frames: int) -> Int[np.ndarray, "kept"]:
    """The frames of the pairs, and enough others to know the room's extent."""
    spread = np.linspace(0, max(0, n_frames - 1), min(n_frames, _SPREAD_FRAMES)).astype(np.int64)
    return np.union1d(spread, _pairs(n_frames))
