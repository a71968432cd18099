"""Trajectories as text files that evaluation tools read; the only place with q_xyzw."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from nbtrack.core.errors import DataError, MissingError
from nbtrack.core.files import write_text_atomic
from nbtrack.data.sequence import FRAMES_PER_SECOND

_COLUMNS = "timestamp tx ty tz qx qy qz qw"


def write_tum(
    path: Path, frame_ids: Int[np.ndarray, "n"], T_world_camera: Float[np.ndarray, "n 4 4"]
) -> None:
    """Writes `tum_text` to a file."""
    write_text_atomic(path, tum_text(frame_ids, T_world_camera))


def tum_text(frame_ids: Int[np.ndarray, "n"], T_world_camera: Float[np.ndarray, "n 4 4"]) -> str:
    """Camera-to-world poses (m, OpenCV camera axes) in TUM format, one frame a line.

    Numbers have the digits that restore the same double. A quaternion's sign is chosen so that
    qw >= 0.

    Args:
        frame_ids: frame numbers in the sequence; the timestamp (s) is the number
            divided by 30, the recordings' frame rate, whatever rate tracking ran at.

    Source: TUM RGB-D benchmark, trajectory format.
    """
    T_world_camera = np.asarray(T_world_camera, dtype=np.float64)
    q_xyzw = Rotation.from_matrix(T_world_camera[:, :3, :3]).as_quat(canonical=True)
    # Adding zero turns -0.0 into 0.0.
    rows = np.column_stack([frame_ids / FRAMES_PER_SECOND, T_world_camera[:, :3, 3], q_xyzw]) + 0.0
    lines = [f"# {_COLUMNS}"] + [" ".join(map(repr, row)) for row in rows.tolist()]
    return "\n".join(lines) + "\n"


def write_kitti(path: Path, T_world_camera: Float[np.ndarray, "n 4 4"]) -> None:
    """Writes camera-to-world poses (m, OpenCV camera axes) in KITTI's format.

    Twelve numbers a line: the upper three rows of the matrix, row by row, with the digits that
    restore the same double. There are no time stamps, so a frame is known by its line alone.

    Source: KITTI odometry benchmark. Its own files begin at the identity; ours keep the world
    frame (our choice: `evo_ape kitti` aligns if it is asked to).
    """
    rows = np.asarray(T_world_camera, dtype=np.float64)[:, :3].reshape(-1, 12) + 0.0
    write_text_atomic(path, "\n".join(" ".join(map(repr, row)) for row in rows.tolist()) + "\n")


def read_tum(path: Path) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 4 4"]]:
    """Timestamps (s) and camera-to-world poses (m) of a TUM file; `#` lines are skipped.

    Raises:
        MissingError: there is no such file.
        DataError: a line does not hold eight finite numbers and a unit quaternion, or the file
            holds no pose; names the file and the line.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingError(
            f"no file {path}; expected a trajectory in TUM format; track a sequence to make one"
        )
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    rows = [
        _parse_line(line, f"{path}, line {number}")
        for number, line in enumerate(lines, start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not rows:
        raise DataError(f"{path} holds no pose; expected lines of `{_COLUMNS}`; write it anew")
    numbers = np.array(rows)
    T_world_camera = np.tile(np.eye(4), (len(rows), 1, 1))
    T_world_camera[:, :3, :3] = Rotation.from_quat(numbers[:, 4:]).as_matrix()
    T_world_camera[:, :3, 3] = numbers[:, 1:4]
    return numbers[:, 0], T_world_camera


def _parse_line(line: str, where: str) -> list[float]:
    """The eight numbers of a line; `where` names it in errors."""
    words = line.split()
    advice = f"expected `{_COLUMNS}` separated by blanks; correct or remove the line"
    if len(words) != 8:
        raise DataError(f"{where} has {len(words)} columns; {advice}")
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise DataError(f"{where} holds a word that is not a number; {advice}") from None
    if not np.isfinite(numbers).all():
        raise DataError(f"{where} holds a number that is not finite; {advice}")
    norm = float(np.linalg.norm(numbers[4:]))
    # Files rounded to four decimals miss the unit norm by up to 1e-4; a mixed-up column by more.
    if abs(norm - 1) > 1e-2:
        raise DataError(f"{where} has a quaternion of norm {norm:.3g}; {advice} (norm 1)")
    return numbers
