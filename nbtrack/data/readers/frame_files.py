"""Image files that belong together: listed in natural order, paired, and refused where odd."""

import re
from pathlib import Path

from nbtrack.core.errors import DataError, MissingError

_SUFFIXES = (".png", ".jpg", ".jpeg")


def numbered_files(
    folder: Path, example: str, pattern: str = "*", suffixes: tuple[str, ...] = _SUFFIXES
) -> list[Path]:
    """Files in natural order: `img2` before `img10`.

    Args:
        example: names that are expected, told when there is none.
        pattern: of the file names, as a shell has it.

    Raises:
        MissingError: there is no such file.
    """
    files = []
    if folder.is_dir():
        files = [p for p in folder.glob(pattern) if p.suffix.lower() in suffixes and p.is_file()]
    if not files:
        kind = "images" if suffixes == _SUFFIXES else "files"
        raise MissingError(f"no {kind} in {folder}: it needs files like {example}")
    # The name decides between img1 and img01.
    return sorted(files, key=lambda path: (_numbers(path), path.name))


def frame_number(path: Path) -> int | None:
    """The last number in a file's name."""
    numbers = _numbers(path)
    return numbers[-1] if numbers else None


def check_paired(folder: Path, color_files: list[Path], others: list[Path], what: str) -> None:
    """Every image has its depth map, or its pose: as many, with the same frame numbers.

    Args:
        what: `depth maps`, or `poses`.

    Raises:
        DataError: the numbers differ.
    """
    if len(color_files) != len(others):
        raise DataError(
            f"{folder} has {len(color_files)} images but {len(others)} {what} in "
            f"{others[0].parent.name}/: every image needs one; remove or add the odd files"
        )
    for image, other in zip(color_files, others, strict=True):
        if frame_number(image) != frame_number(other):
            raise DataError(
                f"{image} stands beside {other}: the frame numbers in the names must agree; rename "
                "or remove the odd one"
            )


def _numbers(path: Path) -> list[int]:
    # A dot ends the stem: frame-000001.color.png counts as 1. Of more digits no camera is capable.
    return [int(digits[-18:]) for digits in re.findall(r"[0-9]+", path.stem)]
