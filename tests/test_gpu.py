"""What a GPU must do as a CPU does, on a real one, if any; and what its errors mean."""

from pathlib import Path

import numpy as np
import pytest
import torch
from box_room import walk

from nbtrack import TRACKERS, make_tracker
from nbtrack.core.bounds import SceneBounds
from nbtrack.fields import NetworkSettings, field_class, make_field
from nbtrack.machinery import launches
from nbtrack.machinery.device import choose_device
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.files import naming_damaged
from nbtrack.mapping.fit import _Fit
from nbtrack.tracking import StepBudget, track_sequence

BOUNDS = SceneBounds((-1.2, -1.0, -1.4), (1.2, 1.0, 1.4))
SEQUENCE = walk(4)
CPU = torch.device("cpu")
cuda = pytest.param("cuda", marks=pytest.mark.gpu)


@pytest.fixture
def device(request) -> torch.device:
    if not torch.cuda.is_available():
        pytest.skip("no GPU")
    return torch.device(request.param)


def poses(name: str, field_name: str, device: torch.device) -> np.ndarray:
    """Tracked, in a small network that has learnt nothing."""
    field = make_field(field_name, NetworkSettings(width=32), BOUNDS, seed=3).to(device)
    settings = TRACKERS[name].Settings(n_pixels=48)
    tracker = make_tracker(name, field, np.eye(4), StepBudget(2.5), settings)
    return track_sequence(tracker, SEQUENCE).T_estimated


def fit_on(device: torch.device, name: str) -> _Fit:
    extra = {"n_surface_points": 8} if name == "neus_plus" else {}
    settings = field_class(name).Settings(iterations=20, n_rays=16, **extra)
    field = make_field(name, NetworkSettings(width=32), BOUNDS, seed=3).to(device)
    return _Fit({"seed": 0}, settings, field, SEQUENCE, np.arange(3))


@pytest.mark.parametrize("device", [cuda], indirect=True)
@pytest.mark.parametrize(
    ("name", "field_name"), [("sdf", "neus"), ("vr", "imap"), ("vr", "neus"), ("lm", "neus")]
)
def test_tracking_on_a_device(name: str, field_name: str, device: torch.device) -> None:
    """Catches tensors left on the host, double precision that a device lacks, and other poses than
    a few steps of Adam from the start can reach."""
    expected, found = poses(name, field_name, CPU), poses(name, field_name, device)
    np.testing.assert_allclose(found, expected, atol=0.02)  # each device draws other pixels


@pytest.mark.parametrize("device", [cuda], indirect=True)
@pytest.mark.parametrize(("name", "field_name"), [("sdf", "neus"), ("vr", "imap"), ("vr", "neus")])
def test_recorded_steps(name: str, field_name: str, device: torch.device, monkeypatch) -> None:
    """Catches recorded steps that draw other numbers, or keep what changes."""
    recorded = poses(name, field_name, device)
    monkeypatch.setattr(launches, "CALLS_BEFORE_RECORDING", 1_000_000)
    np.testing.assert_allclose(recorded, poses(name, field_name, device), atol=1e-5)


@pytest.mark.parametrize("device", [cuda], indirect=True)
@pytest.mark.parametrize("name", ["imap", "neus", "neus_plus"])
def test_recorded_iterations(name: str, device: torch.device, monkeypatch) -> None:
    """Catches tensors left on the host, losses that are not finite, and recorded iterations that
    draw other numbers, or keep what changes."""
    totals = []
    for calls in (launches.CALLS_BEFORE_RECORDING, 1_000_000):
        monkeypatch.setattr(launches, "CALLS_BEFORE_RECORDING", calls)
        fit = fit_on(device, name)
        fit._advance(range(15))
        assert (fit.recording.replay is None) == (calls > 15)
        totals.append([row["total"] for row in fit.history])
    np.testing.assert_allclose(*totals, rtol=1e-3)
    assert np.isfinite(totals).all()


def test_a_map_goes_on_only_where_it_began(tmp_path: Path) -> None:
    """Catches a checkpoint from another kind of device that is called damaged."""
    checkpoint = tmp_path / "mapping.pt"
    fit_on(CPU, "imap").run(checkpoint, lambda *_: None)
    fit = fit_on(CPU, "imap")
    fit.run(checkpoint, lambda *_: pytest.fail("nothing was left to do"))
    fit.recipe["device"] = "cuda"
    with pytest.raises(DataError, match=r"mapping.pt was made with another device:"):
        fit.run(checkpoint, lambda *_: None)


@pytest.mark.parametrize("kind", [torch.OutOfMemoryError, torch.AcceleratorError])
def test_a_device_that_fails_is_no_damage(kind: type, tmp_path: Path) -> None:
    """Catches the advice to delete a sound file because a GPU was full."""
    with pytest.raises(kind), naming_damaged(tmp_path):
        raise kind("CUDA error: out of memory")


def test_the_device_is_the_named_one(monkeypatch) -> None:
    """Catches tests that run commands on a GPU because there is one."""
    assert choose_device().type == "cpu"
    monkeypatch.setenv("NBTRACK_DEVICE", "cpu:1")
    assert choose_device() == torch.device("cpu:1")
