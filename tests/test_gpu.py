"""What a GPU does otherwise than a CPU, on an emulated one; and the same on a real one, if any."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from box_room import BoxRoom, walk
from emulated import DEVICE, emulated, pretend, pretended_graph, refuse

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.capture import WARM_STEPS, Recorded
from nbtrack.core.device import choose_device, named_device
from nbtrack.core.errors import DataError
from nbtrack.core.files import naming_damaged
from nbtrack.fields import NetworkSettings, field_class, make_field
from nbtrack.mapping.fit import _Fit
from nbtrack.tracking import TRACKERS, StepBudget, Tracker, make_tracker, track_sequence

BOUNDS = SceneBounds((-1.2, -1.0, -1.4), (1.2, 1.0, 1.4))
SEQUENCE = walk(4)
on_gpu = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")]
# Kernels a step, and what makes the host wait for the device in it. They may fall, not grow.
STEPS = {
    ("sdf", "neus"): (99, []),
    ("vr", "imap"): (303, []),
    ("vr", "neus"): (320, []),
    ("lm", "neus"): (0, []),  # on the host, in a grid that was copied there once
}
ITERATIONS = {"imap": 248, "neus": 394, "neus_plus": 724}  # kernels of mapping


def tracker_of(name: str, field_name: str, device: torch.device, **settings: float) -> Tracker:
    """In a small network that has learnt nothing; at the origin."""
    field = make_field(field_name, NetworkSettings(width=32), BOUNDS, seed=3).to(device)
    settings = TRACKERS[name].Settings(**{"n_pixels": 48, **settings})
    return make_tracker(name, field, np.eye(4), StepBudget(2.5), settings)


def poses(tracker: Tracker) -> np.ndarray:
    return track_sequence(tracker, SEQUENCE).T_estimated


@pytest.mark.parametrize(("name", "field_name"), STEPS)
def test_tracking_on_a_device(name: str, field_name: str, capsys: pytest.CaptureFixture) -> None:
    """Catches tensors left on the host, double precision on the device, waits and copies in a step,
    more kernels than before; and a step that cannot be recorded, that is not reported."""
    expected = poses(tracker_of(name, field_name, torch.device("cpu")))
    with emulated() as device:
        tracker = tracker_of(name, field_name, DEVICE)
        found = poses(tracker)
        there = tracker.device
        tracker.begin(SEQUENCE[1].to(there), torch.eye(4, device=there)[None])
        kernels, waits = device.kernels.total(), len(device.waits)
        tracker.step()
        kernels, waits = device.kernels.total() - kernels, device.waits[waits:]
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert capsys.readouterr().err.count("cannot be recorded here") == (name != "lm")
    most, expected = STEPS[name, field_name]
    assert kernels <= most
    assert waits == expected


def fit_on(device: torch.device, name: str) -> _Fit:
    settings = replace(field_class(name).Settings(), iterations=20, n_rays=16)
    if name == "neus_plus":
        settings = replace(settings, n_surface_points=8)
    field = make_field(name, NetworkSettings(width=32), BOUNDS, seed=3).to(device)
    return _Fit({"seed": 0}, settings, field, SEQUENCE, np.arange(3))


@pytest.mark.parametrize("name", ITERATIONS)
def test_mapping_on_a_device(name: str) -> None:
    """Catches the same in mapping: more iterations at once wait and copy no more often."""
    with emulated() as device:
        fit, counted = fit_on(DEVICE, name), []
        for iterations in (range(2), range(2, 4), range(4, 9)):
            before = device.kernels.total(), len(device.waits)
            fit._advance(iterations)
            counted.append((device.kernels.total() - before[0], len(device.waits) - before[1]))
    (_, (kernels, waits), (more_kernels, more_waits)) = counted
    assert more_waits == waits
    assert (more_kernels - kernels) / 3 <= ITERATIONS[name]
    plain = fit_on(torch.device("cpu"), name)
    plain._advance(range(9))
    assert fit.history[8]["total"] == pytest.approx(plain.history[8]["total"], rel=1e-3)


def test_a_map_goes_on_only_where_it_began(tmp_path: Path) -> None:
    """Catches a checkpoint from another kind of device that is called damaged."""
    fit_on(torch.device("cpu"), "imap")._save(tmp_path / "mapping.pt")
    fit_on(torch.device("cpu"), "imap")._load(tmp_path / "mapping.pt")
    with emulated(), pytest.raises(DataError, match=r"mapping.pt was made with another device:"):
        fit_on(DEVICE, "imap")._load(tmp_path / "mapping.pt")


@pytest.mark.parametrize("kind", [torch.OutOfMemoryError, torch.AcceleratorError])
def test_a_device_that_fails_is_no_damage(kind: type, tmp_path: Path) -> None:
    """Catches the advice to delete a sound file because a GPU was full."""
    with pytest.raises(kind), naming_damaged(tmp_path):
        raise kind("CUDA error: out of memory")


def test_the_device_is_the_named_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches `cuda:1`, whose steps would be recorded on `cuda:0`, as nothing; and tests that run
    commands on a GPU because there is one."""
    chosen = []
    monkeypatch.setattr("torch.accelerator.set_device_index", chosen.append)
    monkeypatch.setattr("torch.accelerator.current_accelerator", lambda **_: DEVICE)
    assert [named_device("cpu:1"), choose_device().type] == [torch.device("cpu:1"), "cpu"]
    assert chosen == [1]


@pytest.mark.parametrize(("name", "field_name"), [("sdf", "neus"), ("vr", "imap"), ("vr", "neus")])
def test_replays_are_steps(name: str, field_name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a frame, pose, moment or count of steps that a replay takes from the frame that was
    recorded, random numbers drawn once, and a warm-up that counts: frames differ in what they
    measure, and all poses must be those of single steps, to the last bit."""
    found, calls = [], []
    for graph_of in (lambda step, generator: step, pretended_graph):
        pretend(monkeypatch, graph_of)
        tracker = tracker_of(name, field_name, torch.device("cpu"), motion_model="better_of_both")
        descend = tracker._descend
        tracker._descend = lambda descend=descend: calls.append(1) or descend()
        sequence = walk(5, BoxRoom(), 24)
        sequence.depths_mm[2, :9] = 0
        found.append(track_sequence(tracker, sequence))
    np.testing.assert_array_equal(found[1].T_estimated, found[0].T_estimated)
    np.testing.assert_array_equal(found[1].frames["loss"], found[0].frames["loss"])
    assert np.abs(np.diff(found[1].T_estimated[:, :3, 3], axis=0)).max() > 1e-4
    assert len(calls) == WARM_STEPS + 1 + 10 + WARM_STEPS + 1


class Owner:
    """Of a step that adds random numbers, and may look at them."""

    def __init__(self, device: str, looks: bool) -> None:
        self.generator, self.looks = torch.Generator(device).manual_seed(0), looks
        self.sum = torch.zeros((), device=device)

    def step(self) -> torch.Tensor:
        self.sum += torch.rand((), generator=self.generator, device=self.sum.device)
        return self.sum.new_tensor(self.sum.item()) if self.looks else self.sum


@pytest.mark.parametrize("looks", [True, False])
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=on_gpu)])
def test_a_step_that_cannot_be_recorded_goes_on(device, looks, monkeypatch, capsys) -> None:
    """Catches a failed recording that ends the run, draws random numbers or is not reported; on a
    GPU, a stream or generator that is left in it."""
    if device == "cpu":
        pretend(monkeypatch, refuse if looks else lambda step, generator: step)
    plain, owner = Owner(device, looks), Owner(device, looks)
    step = Recorded(owner.step, owner)
    assert [float(step()) for _ in range(7)] == [float(plain.step()) for _ in range(7)]
    assert capsys.readouterr().err.count("\n") == looks
    if device == "cuda":
        assert torch.cuda.current_stream() == torch.cuda.default_stream()


@pytest.mark.parametrize(("name", "field_name"), [("sdf", "neus"), ("vr", "imap")])
@pytest.mark.parametrize("device", [pytest.param("cuda", marks=on_gpu)])
def test_a_real_recording(name: str, field_name: str, device: str, monkeypatch, capsys) -> None:
    """Catches a graph that does something else than the steps that it was recorded from."""
    device = torch.device(device)
    recorded = poses(tracker_of(name, field_name, device))
    assert not capsys.readouterr().err
    monkeypatch.setattr("nbtrack.core.capture.graph_of", refuse)
    np.testing.assert_allclose(recorded, poses(tracker_of(name, field_name, device)), atol=1e-4)
