"""A recording whose files are found and whose texts are read, before any pixel is decoded."""

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from nbtrack.data.readers.calibration import Calibration
from nbtrack.data.readers.declaration import Declaration


@dataclass(frozen=True, eq=False)
class Recording:
    """What a reader finds: paired image files, poses as the file has them, and their meaning."""

    folder: Path
    color_files: list[Path]  # in the order of the recording, frame by frame
    depth_files: list[Path]
    file_poses: Float[np.ndarray, "frames 4 4"]  # as `declared` says; NaN without a pose
    pose_file: Path  # named in messages; a folder where every frame has a file
    calibration: Calibration  # of the depth images, and of the colour that lies on them
    declared: Declaration
    text_files: list[Path]  # everything read beside the images
    times: Float[np.ndarray, "frames"] | None = None  # s, as recorded
    resize_color: bool = False  # colour has another size and shows the same view

    def __len__(self) -> int:
        return len(self.color_files)

    @property
    def name(self) -> str:
        """The folder's own name."""
        return self.folder.resolve().name

    @cached_property
    def T_world_camera(self) -> Float[np.ndarray, "frames 4 4"]:
        """Camera-to-world poses with OpenCV's camera axes; NaN where there is none."""
        return self.declared.convention.to_opencv(self.file_poses)

    @cached_property
    def has_pose(self) -> Bool[np.ndarray, "frames"]:
        """Which frames have a pose."""
        return np.isfinite(self.file_poses).all(axis=(1, 2))

    @property
    def rate_hz(self) -> float:
        """Frames a second: measured where the frames have times, else as declared."""
        if self.times is None or len(self.times) < 2 or np.ptp(self.times) <= 0:
            return float(self.declared.frame_rate)
        return float(1 / np.median(np.diff(self.times)))

    @property
    def file_sizes(self) -> list[tuple[str, str, int]]:
        """Folder, name and bytes of every image: they change when a recording does."""
        files = self.color_files + self.depth_files
        return [(file.parent.name, file.name, os.path.getsize(file)) for file in files]
