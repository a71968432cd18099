"""Run every test with array shapes and types checked at each call of the package."""

import importlib

import pytest
from jaxtyping import install_import_hook

# What modules of the package import, the hook seeks under another name among the compiled modules,
# does not find and compiles anew, in every process. So libraries come before it.
LIBRARIES = (
    "beartype", "cv2", "distributed", "numba", "pandas", "scipy.interpolate", "scipy.ndimage",
    "scipy.sparse.linalg", "scipy.spatial", "trimesh",
)  # fmt: skip


def pytest_collectstart(collector: pytest.Collector) -> None:
    """Only where tests run, not in a process that hands them out: this takes seconds."""
    if isinstance(collector, pytest.Session):
        for library in LIBRARIES:
            importlib.import_module(library)
        install_import_hook("nbtrack", "beartype.beartype")
