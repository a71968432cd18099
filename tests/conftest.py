"""Fixtures that several test modules ask for by name. Those of pytest itself go without types."""

import os
import shutil
from pathlib import Path
from unittest import mock

import jaxtyping
import pytest
from finished import GIVEN, MAP, OWN, isolate

for name in ("PRESET", "CONFIG", "SET", "DATA", "RUNS"):  # of whoever runs the tests
    os.environ.pop(f"NBTRACK_{name}", None)
os.environ["NBTRACK_DEVICE"] = "cpu"  # where there is a GPU too: what is tested there says so
os.environ["OMP_NUM_THREADS"] = "1"  # images are so small that threads would only wait for others
LONG = [
    "test_lm_solver", "test_grid", "test_notebooks", "test_misfits", "test_tables_of_runs",
    "test_data_check", "test_cli", "test_installed", "test_faults", "test_own_method",
]  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What others find compiled comes first, then the longest modules: at the end they would leave
    the other processes idle."""
    order = {name: place for place, name in enumerate(LONG)}
    items.sort(key=lambda item: order.get(item.path.stem, len(LONG)))


@pytest.fixture(scope="session", autouse=True)
def cheap_defaults():
    """Most tests do not look at what their maps are worth; and where none says how many workers it
    wants, jobs run here: each worker would import torch for seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nbtrack.machinery.device.usable_cores", lambda: 1)
        patch.setattr("nbtrack.experiments.quality.POINTS_SCORED", 200)
        patch.setattr("nbtrack.mapping.holdout._MISFIT_FRAMES", 1)
        yield


@pytest.fixture(autouse=True)
def settings_stay_inside(tmp_path: Path):
    """A cache for each test, unless its module has one; and what a command sets for its own process
    must not reach the next test."""
    import torch

    with mock.patch.dict(os.environ):
        os.environ.setdefault("NBTRACK_RUNS", str(tmp_path / "runs"))
        yield
    torch.set_num_threads(1)


@pytest.fixture
def unchecked(monkeypatch) -> None:
    """Calls of the package go without checks of types, as a user's; it takes half the time."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture
def generator():
    """Random numbers of torch that are the same in every run."""
    import torch

    return torch.Generator().manual_seed(0)


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    """A recording as a plain folder."""
    from recordings import write_recording

    return write_recording("plain", tmp_path / "plain")


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> Path:
    """Results: a small map (`map`), the same as one file (`room`), a run in the map (`run`), and a
    cache (`runs`)."""
    from nbtrack.cli import main

    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        isolate(folder, patch)
        for command in (MAP, OWN, [*GIVEN, "map"]):
            assert main(command) == 0
        shutil.copy("map/map.safetensors", "room")
    return folder


@pytest.fixture
def work(finished: Path, tmp_path: Path, monkeypatch) -> Path:
    """A copy of the finished results as the working folder."""
    shutil.copytree(finished, tmp_path / "work")
    isolate(tmp_path / "work", monkeypatch)
    return tmp_path / "work"
