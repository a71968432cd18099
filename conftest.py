"""Run every test with array shapes and types checked at each call of the package."""

import importlib
import os
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

# What modules of the package import, the hook seeks under another name among the compiled modules,
# does not find and compiles anew, in every process. So libraries come before it.
LIBRARIES = (
    "beartype", "cv2", "distributed", "numba", "pandas", "scipy.interpolate", "scipy.ndimage",
    "scipy.sparse.linalg", "scipy.spatial", "trimesh",
)  # fmt: skip


def pytest_configure(config: pytest.Config) -> None:
    """Notebooks that are compared side by side have a core each: their jobs then need no further
    processes, which would only import the package once more and wait for each other."""
    worker = getattr(config, "workerinput", {}).get("workerid", "")
    if worker and config.getoption("nbval", False) and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[int(worker.removeprefix("gw")) % len(cores)]})


def pytest_collectstart(collector: pytest.Collector) -> None:
    """Only where tests of the package run: this takes seconds, and notebooks have own processes."""
    if isinstance(collector, pytest.Session) and not collector.config.getoption("nbval", False):
        for library in LIBRARIES:
            importlib.import_module(library)
        install_import_hook("nbtrack", "beartype.beartype")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With --nbval the notebooks are what is tested; None leaves the question to others."""
    is_code = collection_path.suffix == ".py"
    return True if is_code and config.getoption("nbval", False) else None


def pytest_collection_modifyitems(items: list[pytest.Item], config: pytest.Config) -> None:
    """Notebooks that need the same maps do not begin together: the first, the appendices, 2 to 7,
    and at last the fifth, which needs the maps and runs of all."""
    if config.getoption("nbval", False):
        items.sort(key=lambda item: ("01", "A", "0", "05").index(_group(item.path.stem)))


def _group(notebook: str) -> str:
    """The part of a notebook's name by which it takes its turn."""
    return notebook[:2] if notebook[:2] in ("01", "05") else notebook[0]
