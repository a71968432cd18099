"""Where the project keeps things on disk."""

import os
from pathlib import Path

PROJECT_ROOT = Path(__file__).resolve().parents[2]
PAPER_TABLES = PROJECT_ROOT / "paper_tables"


def runs_folder() -> Path:
    """Cache of rooms, maps and trajectories: `NBTRACK_RUNS`, else `runs/` of the project."""
    return Path(os.environ.get("NBTRACK_RUNS") or PROJECT_ROOT / "runs").resolve()


def data_folder() -> Path:
    """Folder with downloaded scenes: `NBTRACK_DATA`, else `data/` of the project."""
    return Path(os.environ.get("NBTRACK_DATA") or PROJECT_ROOT / "data").resolve()
