"""What the commands for data do and print: making, checking and converting recordings."""

import os
from pathlib import Path

from tqdm.auto import tqdm

from nbtrack.data.check import check_sequence
from nbtrack.data.convert import convert_sequence
from nbtrack.data.sequence import parse_frames
from nbtrack.synthetic import make_room


def make_command(room: str, out: Path, n_frames: int, width: int, seed: int) -> None:
    """Write a synthetic room as a sequence folder."""
    with tqdm(total=n_frames, desc=room, unit="frame", delay=1.0) as bar:
        make_room(
            room, out, n_frames, width, width * 3 // 4, seed, workers=os.cpu_count() or 1,
            progress=lambda done, total: bar.update(done - bar.n),
        )  # fmt: skip
    print(f"{out}: {room}, {n_frames} frames of {width}x{width * 3 // 4}, seed {seed}")


def check_command(
    folder: Path,
    depth_folder: str | None,
    pose_file: str | None,
    format: str | None = None,
    out: Path | None = None,
) -> None:
    """Validate a recording; print what it holds and what is wrong, and draw it if asked to."""
    report = check_sequence(folder, depth_folder, pose_file, True, format)
    print(report)
    if out is None:
        return
    from nbtrack.plots.recording import plot_recording

    path = out if out.suffix.lower() == ".png" else out / "check.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    plot_recording(report.cloud, report.T_world_camera, report.title).savefig(path)
    print(f"  picture         {path}")


def convert_command(
    folder: Path,
    out: Path,
    format: str | None = None,
    frames: str = ":",
    depth_folder: str | None = None,
    pose_file: str | None = None,
) -> None:
    """Write a recording in the Neural RGB-D layout; print what became of it."""
    converted = convert_sequence(
        folder, out, format, parse_frames(frames), depth_folder, pose_file, progress=True
    )
    print(converted)
