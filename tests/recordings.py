"""One short recording of a synthetic room, written as every format has it, by its documentation.

Writing uses nothing of the readers: a convention that both got wrong would go unnoticed.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, astuple, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nbtrack.core.camera import Intrinsics
from nbtrack.recordings.reading import read_sequence
from nbtrack.synthetic import add_kinect_noise, build_room, filter_depth, render_frame
from nbtrack.synthetic.motion import handheld_trajectory

# The focal length of 7-Scenes at this width; pixel centres at integer + 0.5.
CAMERA = Intrinsics.from_focal(48, 36, 585.0 * 48 / 640)
N_FRAMES = 6
START = 1305031102.175  # s, of the first frame in formats with times


class Source(NamedTuple):
    """What is written: RGB colours, depth in mm, poses with OpenCV axes, camera-to-world."""

    colors: np.ndarray
    depths_mm: np.ndarray
    poses: np.ndarray
    camera: Intrinsics = CAMERA


Change = Callable[[Source], Source]


@cache
def source(room: str = "living_room", n_frames: int = N_FRAMES, stride: int = 3) -> Source:
    """Clean frames; every `stride`-th of a hand-held camera's."""
    poses = handheld_trajectory(build_room(room), n_frames * stride, 0)[::stride]
    rendered = [render_frame(build_room(room), CAMERA, pose) for pose in poses]
    colors = np.stack([color for color, _, _ in rendered])
    depths = np.stack([np.rint(1000 * depth).astype(np.uint16) for _, depth, _ in rendered])
    depths[:, :2, :3] = 0  # a corner without measurement
    return Source(colors, depths, poses)


def with_noise(data: Source) -> Source:
    """With a Kinect's noise, filtered as datasets have it."""
    depths, rng = [], np.random.default_rng(0)
    for clean in data.depths_mm / 1000:
        noisy = add_kinect_noise(clean, data.camera.fx, rng)
        depths.append(np.rint(1000 * filter_depth(noisy)).astype(np.uint16))
    return data._replace(depths_mm=np.stack(depths))


def thinned(data: Source, step: int) -> Source:
    """Every `step`-th pixel along both sides; the principal point moves with the first one kept."""
    first, c = step // 2, data.camera
    kept = (slice(None), slice(first, None, step), slice(first, None, step))
    colors, depths_mm = data.colors[kept], data.depths_mm[kept]
    middle = [(place - first - 0.5) / step + 0.5 for place in (c.cx, c.cy)]
    camera = Intrinsics(*depths_mm.shape[:0:-1], c.fx / step, c.fy / step, *middle)
    return Source(colors, depths_mm, data.poses, camera)


def larger(data: Source, factor: int) -> Source:
    """Colours so many times as large as depth, and their camera, whose lengths are pixels."""
    colors = data.colors.repeat(factor, axis=1).repeat(factor, axis=2)
    camera = Intrinsics(*(factor * length for length in astuple(data.camera)))
    return data._replace(colors=colors, camera=camera)


def real(name: str, frames: slice, step: int) -> Source:
    """Every `step`-th pixel of a real recording; where there is none, the test is skipped."""
    folder = Path(__file__).resolve().parents[2] / "shared/data" / name
    if not folder.is_dir():
        pytest.skip("no real recording here")
    sequence = read_sequence(folder, frames)
    # The layout of the office is that of a format with other axes.
    axes = [1.0, -1, -1, 1] if name == "real_office" else [1.0, 1, 1, 1]
    images, poses = (sequence.colors, sequence.depths_mm), sequence.T_world_camera @ np.diag(axes)
    return thinned(Source(*images, poses, sequence.intrinsics), step)


def depth(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda data: data._replace(depths_mm=np.rint(change(data.depths_mm)).astype(np.uint16))


def short(b: float) -> Change:
    """Depths m as a camera gives them whose quadratic error is b (1/m): true = m + b m²."""
    return depth(lambda true_mm: (np.sqrt(1 + 4 * b * true_mm / 1000) - 1) / (2 * b / 1000))


def camera(f: float, c: float = 1.0) -> Change:
    """Focal lengths and principal point times a factor each."""

    def change(data: Source) -> Source:
        k = data.camera
        scaled = replace(k, fx=f * k.fx, fy=f * k.fy, cx=c * k.cx, cy=c * k.cy)
        return data._replace(camera=scaled)

    return change


def positions(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def moved(data: Source) -> Source:
        poses = data.poses.copy()
        poses[:, :3, 3] = change(poses[:, :3, 3])
        return data._replace(poses=poses)

    return moved


def write_image(path: Path, image: np.ndarray) -> None:
    """RGB colour or 16-bit depth; JPEG as good as it gets."""
    path.parent.mkdir(parents=True, exist_ok=True)
    bgr = image[..., ::-1] if image.ndim == 3 else image
    options = [cv2.IMWRITE_JPEG_QUALITY, 100] if path.suffix == ".jpg" else []
    assert cv2.imwrite(str(path), np.ascontiguousarray(bgr), options)


def along_rays(data: Source, unit: float = 1.0) -> Source:
    """Depth as distances along the rays; `unit` values a millimetre."""
    rows, columns = np.indices(data.depths_mm.shape[1:])
    x = (columns + 0.5 - data.camera.cx) / data.camera.fx
    y = (rows + 0.5 - data.camera.cy) / data.camera.fy
    raw = np.rint(unit * data.depths_mm * np.sqrt(1 + x**2 + y**2)).astype(np.uint16)
    return data._replace(depths_mm=raw)


def matrix_text(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(map(repr, row)) for row in np.atleast_2d(matrix).tolist()) + "\n"


def camera_matrix(camera: Intrinsics, size: int = 3) -> np.ndarray:
    """OpenCV's, with pixel centres at whole numbers."""
    K = np.eye(size)
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5
    return K


def camera_words(camera: Intrinsics, width: str, height: str) -> dict[str, float]:
    """The same by name."""
    sizes, K = {width: camera.width, height: camera.height}, camera_matrix(camera)
    return {**sizes, "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}


def change_camera(folder: Path, **values: object) -> None:
    """Other entries in the camera's file of a plain folder; None takes one out."""
    content = json.loads((folder / "intrinsics.json").read_text()) | values
    content = {key: value for key, value in content.items() if value is not None}
    (folder / "intrinsics.json").write_text(json.dumps(content))


def tum_lines(times: np.ndarray, poses: np.ndarray, order: str = "xyzw") -> str:
    q = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=order == "wxyz")
    return matrix_text(np.column_stack([times, poses[:, :3, 3], q]))


def write_images(
    folder: Path, data: Source, color: str = "color/{:06}.png", depth: str = "depth/{:06}.png"
) -> None:
    """By default those of a plain folder."""
    for i, (rgb, values) in enumerate(zip(data.colors, data.depths_mm, strict=True)):
        write_image(folder / color.format(i), rgb)
        write_image(folder / depth.format(i), values)


def write_matrices(folder: Path, data: Source, settings: str = "") -> Path:
    """A plain folder whose poses are matrices, and what it declares; returns `folder`."""
    write_images(folder, data)
    (folder / "poses.txt").write_text(matrix_text(data.poses.reshape(-1, 16)))
    (folder / "intrinsics.txt").write_text(matrix_text(camera_matrix(data.camera)))
    (folder / "sequence.toml").write_text(settings + "\n")
    return folder


def write_neural_rgbd(folder: Path, data: Source) -> None:
    opengl = data.poses @ np.diag([1.0, -1, -1, 1])
    write_images(folder, data, "images/img{}.png", "depth_filtered/depth{}.png")
    (folder / "poses.txt").write_text(matrix_text(opengl.reshape(-1, 4)))
    (folder / "focal.txt").write_text(f"{data.camera.fx!r}\n")


def write_tum(folder: Path, data: Source) -> None:
    """With a colour image that has no depth, a depth map that has no image, and denser poses."""
    times = START + np.arange(len(data.poses)) / 10
    lists = {"rgb": ["# timestamp filename"], "depth": ["# timestamp filename"]}
    for i, time in enumerate(times):
        both = ("rgb", data.colors[i], 0.0), ("depth", 5 * data.depths_mm[i], 0.011)
        for name, image, late in both:
            file = f"{name}/{time + late:.6f}.png"
            write_image(folder / file, image)
            lists[name].append(f"{time + late:.6f} {file}")
    # 0.025 s from each other, and from the next frame: too far to belong together.
    for name, image, late in (("rgb", data.colors[0], 0.05), ("depth", data.depths_mm[0], 0.075)):
        write_image(folder / name / "odd.png", image)
        lists[name].append(f"{times[1] + late:.6f} {name}/odd.png")
    for name, lines in lists.items():
        # By time, as a recorder writes it: the head's # comes before all digits.
        (folder / f"{name}.txt").write_text("\n".join(sorted(lines)) + "\n")
    # Between the frames' poses others that must not be taken.
    between = np.tile(np.eye(4), (len(times), 1, 1))
    all_times = np.stack([times + 0.002, times + 0.05], axis=1).ravel()
    all_poses = np.stack([data.poses, between], axis=1).reshape(-1, 4, 4)
    head = "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n"
    (folder / "groundtruth.txt").write_text(head + tum_lines(all_times, all_poses))
    K = camera_matrix(data.camera)
    (folder / "calibration.txt").write_text(matrix_text(K[[0, 1, 0, 1], [0, 1, 2, 2]]))


def write_replica(folder: Path, data: Source) -> None:
    raw = np.rint(data.depths_mm * 6.5535).astype(np.uint16)
    names = "results/frame{:06}.jpg", "results/depth{:06}.png"
    write_images(folder, data._replace(depths_mm=raw), *names)
    (folder / "traj.txt").write_text(matrix_text(data.poses.reshape(-1, 16)))
    params = {**camera_words(data.camera, "w", "h"), "scale": 6553.5}
    (folder.parent / "cam_params.json").write_text(json.dumps({"camera": params}))


def write_seven_scenes(folder: Path, data: Source) -> None:
    raw = np.where(data.depths_mm == 0, np.uint16(65535), data.depths_mm)
    names = "frame-{:06}.color.png", "frame-{:06}.depth.png"
    write_images(folder, data._replace(depths_mm=raw), *names)
    for i, pose in enumerate(data.poses):
        (folder / f"frame-{i:06}.pose.txt").write_text(matrix_text(pose).replace(" ", "\t "))


def write_scannet(folder: Path, data: Source) -> None:
    """Colour twice as large as depth, as the real export's is larger."""
    write_images(folder, larger(data, 2), "color/{}.jpg", "depth/{}.png")
    (folder / "pose").mkdir()
    for i, pose in enumerate(data.poses):
        (folder / f"pose/{i}.txt").write_text(matrix_text(pose))
    (folder / "intrinsic").mkdir()
    text = matrix_text(camera_matrix(data.camera, 4))
    (folder / "intrinsic/intrinsic_depth.txt").write_text(text)


def write_plain(folder: Path, data: Source) -> None:
    write_images(folder, data)
    content = camera_words(data.camera, "width", "height")
    (folder / "intrinsics.json").write_text(json.dumps(content))
    (folder / "trajectory.txt").write_text(tum_lines(np.arange(len(data.poses)) / 30, data.poses))


def write_record3d(folder: Path, data: Source) -> None:
    """An unpacked .r3d file: colour four times as large as depth, which is not packed."""
    large = larger(data, 4)
    for i, depth_mm in enumerate(data.depths_mm):
        write_image(folder / f"rgbd/{i}.jpg", large.colors[i])
        (folder / f"rgbd/{i}.depth").write_bytes((depth_mm / 1000).astype("<f4").tobytes())
    T = data.poses @ np.diag([1.0, -1, -1, 1])
    rows = np.hstack([Rotation.from_matrix(T[:, :3, :3]).as_quat(), T[:, :3, 3]])
    c = large.camera  # in the file from the image's corner, as Apple counts, column by column
    K = [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1]
    content = {"K": K, "poses": rows.tolist(), "w": c.width, "h": c.height, "fps": 60}
    (folder / "metadata").write_text(json.dumps(content))


def write_polycam(folder: Path, data: Source) -> None:
    """Named in microseconds; the app's first estimates of the poses must not be taken."""
    large = larger(data, 4)
    for i, T in enumerate(data.poses @ np.diag([1.0, -1, -1, 1])):
        name = 638443502 + 33333 * i
        write_image(folder / f"keyframes/corrected_images/{name}.jpg", large.colors[i])
        write_image(folder / f"keyframes/depth/{name}.png", data.depths_mm[i])
        for kind, pose in (("cameras", np.eye(4)), ("corrected_cameras", T)):
            t = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
            (folder / "keyframes" / kind).mkdir(exist_ok=True)
            content = json.dumps(asdict(large.camera) | t | {"blur_score": 99.0})
            (folder / f"keyframes/{kind}/{name}.json").write_text(content)


WRITERS: dict[str, Callable[[Path, Source], None]] = {
    "neural_rgbd": write_neural_rgbd, "tum": write_tum, "replica": write_replica,
    "7scenes": write_seven_scenes, "scannet": write_scannet, "plain": write_plain,
    "record3d": write_record3d, "polycam": write_polycam,
}  # fmt: skip


def write_recording(format: str, folder: Path, data: Source | None = None) -> Path:
    """The recording in a format's own conventions; returns `folder`."""
    folder.mkdir(parents=True)
    WRITERS[format](folder, data or source())
    return folder
