"""The engine gives the answers of plain torch: it would catch a wrong term of any derivative."""

import gc
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.config import FieldConfig, TrackingConfig
from nbtrack.core.errors import ConfigError
from nbtrack.data.pixels import PixelSampler, Rays
from nbtrack.data.sequence import RgbdSequence, read_sequence
from nbtrack.fields import make_field
from nbtrack.fields.engine import _CHUNK_ROWS, PULL_BACKS, FrozenMlp, frozen
from nbtrack.synthetic import make_room
from nbtrack.tracking.budget import StepBudget
from nbtrack.tracking.sequence import track_sequence
from nbtrack.tracking.trackers import base, tracker_class

BOUNDS = SceneBounds((-2.0, -1.0, 0.0), (3.0, 2.0, 4.0))
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}


@pytest.fixture(scope="module")
def sequence(tmp_path_factory) -> RgbdSequence:
    folder = tmp_path_factory.mktemp("engine") / "office"
    make_room("office", folder, 4, 32, 24, 0, 1)
    return read_sequence(folder)


def both(name, dtype=torch.float32, width=32):
    field = make_field(name, FieldConfig(width=width), BOUNDS, seed=3).to(dtype)
    field.eval().requires_grad_(False)
    return field, frozen(field)


def points_inside(n, dtype=torch.float32):
    low, high = torch.tensor(BOUNDS.minimum), torch.tensor(BOUNDS.maximum)
    share = torch.rand(n, 3, generator=torch.Generator().manual_seed(0))
    return (low + (high - low) * share).to(dtype)


def close(found, expected, dtype):
    scale = expected.abs().max().clamp_min(1)
    return float((found - expected).abs().max() / scale) < TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["imap", "neus"])
@pytest.mark.parametrize("n", [1, 37, _CHUNK_ROWS + 5])
def test_values_and_position_gradients_are_those_of_autograd(name, dtype, n):
    answers = []
    for field in both(name, dtype):
        points = points_inside(n, dtype).requires_grad_()
        color, value = field(points)
        loss = (color * torch.arange(3)).sum() + (value * value).sum()
        answers.append((color.detach(), value.detach(), *torch.autograd.grad(loss, points)))
    for found, expected in zip(answers[1], answers[0], strict=True):
        assert close(found, expected, dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_linearization_is_that_of_autograd(dtype):
    plain, fast = both("neus", dtype)
    points = points_inside(_CHUNK_ROWS + 3, dtype)
    for name in ("value", "value_gradient", "intensity", "intensity_gradient"):
        expected = getattr(plain.linearize(points), name)
        assert close(getattr(fast.linearize(points), name), expected, dtype), name


@pytest.mark.parametrize("activation", list(PULL_BACKS))
def test_pull_backs_are_the_derivatives_of_their_activations(activation):
    before = torch.linspace(-4, 4, 81, dtype=torch.float64) + 1e-3
    gradient = torch.linspace(1, 2, 81, dtype=torch.float64)
    found = PULL_BACKS[activation](gradient, before, torch.empty_like(before))
    step = 1e-6
    slope = (activation(before + step) - activation(before - step)) / (2 * step)
    assert torch.allclose(found, gradient * slope, atol=1e-8)


@pytest.mark.parametrize("name", ["imap", "neus"])
def test_rendered_pixels_and_their_gradients_are_equal(name):
    depths = torch.linspace(0.2, 3, 16).expand(40, 16)
    found = []
    for field in both(name):
        origins = torch.tensor([0.5, 0.5, 2.0]).expand(40, 3).clone().requires_grad_()
        directions = torch.nn.functional.normalize(points_inside(40) - 1, dim=-1)
        rays = Rays(origins, directions, torch.zeros(40, 3), torch.ones(40))
        rendering = field.render(rays, depths)
        (gradient,) = torch.autograd.grad(rendering.depth.sum(), origins)
        found.append((rendering.depth.detach(), rendering.color.detach(), gradient))
    for fast, plain in zip(found[1], found[0], strict=True):
        assert torch.allclose(fast, plain, atol=2e-5)


def test_two_passes_may_be_open_at_once():
    """Catches memory shared by passes of one size: the first one's derivative would be wrong."""
    plain, fast = both("neus")
    gradients = []
    for field in (plain, fast):
        first, second = points_inside(5).requires_grad_(), (points_inside(5) / 2).requires_grad_()
        loss = field(first)[1].sum() + field(second)[1].square().sum()
        gradients.append(torch.cat(torch.autograd.grad(loss, (first, second))))
    assert close(*gradients, torch.float32)


def test_a_second_backward_pass_is_refused():
    """Its memory may by then hold something else."""
    _, fast = both("neus")
    loss = fast(points_inside(5).requires_grad_())[1].sum()
    loss.backward(retain_graph=True)
    with pytest.raises(RuntimeError, match="one backward pass only"):
        loss.backward()


def test_no_points_give_no_answers():
    _, fast = both("neus")
    color, value = fast(torch.empty(0, 3))
    assert color.shape == (0, 3)
    assert value.shape == (0,)


def test_memory_is_reused_and_bounded_whatever_the_numbers_of_points():
    _, fast = both("neus")
    mlp = fast.mlp
    mlp.linearize(points_inside(64), fast._slopes)
    before = mlp._tape(64).phase.data_ptr()
    mlp.linearize(points_inside(64), fast._slopes)
    assert mlp._tape(64).phase.data_ptr() == before
    for n in range(1, 30):
        mlp.linearize(points_inside(n), fast._slopes)
    assert len(mlp._kept) < 20


def test_training_does_not_reach_a_frozen_copy():
    field, fast = both("neus")
    before = fast(points_inside(4))[1]
    with torch.no_grad():
        field.mlp.head.bias += 1
    assert torch.equal(fast(points_inside(4))[1], before)
    assert isinstance(fast.mlp, FrozenMlp)
    assert not isinstance(field.mlp, FrozenMlp)


@pytest.mark.parametrize(("name", "field_name"), [("sdf", "neus"), ("vr", "imap"), ("lm", "neus")])
def test_both_engines_track_alike(name, field_name, sequence):
    """Same seeds, same steps: the trajectories differ by less than 0.1 mm."""
    field = make_field(field_name, FieldConfig(width=32), BOUNDS, seed=0)
    field.eval().requires_grad_(False)
    paths = [
        track_sequence(
            name, field, sequence, StepBudget(4),
            replace(TrackingConfig(n_pixels=64), engine=engine),
        ).T_estimated
        for engine in ("plain", "fast")
    ]  # fmt: skip
    assert np.abs(paths[1] - paths[0])[:, :3, 3].max() < 1e-4


def test_an_unknown_engine_is_named(sequence):
    sampler = PixelSampler(sequence, torch.device("cpu"))
    with pytest.raises(ConfigError, match="unknown engine 'fats': did you mean 'fast'"):
        tracker_class("sdf")(
            both("neus")[0], sampler, TrackingConfig(engine="fats"), torch.Generator()
        )


class HostTraffic(TorchDispatchMode):
    """Notes the operations that copy between host and device or wait for the device."""

    COPIES = ("lift_fresh", "_local_scalar_dense", "nonzero", "masked_select", "unique")

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        name = operation._overloadpacket.__name__
        if name in self.COPIES:
            self.found.append(name)
        return operation(*args, **(kwargs or {}))


@pytest.mark.parametrize(("name", "field_name"), [("sdf", "neus"), ("vr", "imap")])
def test_a_step_copies_nothing_between_host_and_device(name, field_name, sequence):
    """On CUDA each such copy would wait for the device, and none can be captured in a graph."""
    sampler = PixelSampler(sequence, torch.device("cpu"))
    tracker = tracker_class(name)(
        both(field_name)[0], sampler, TrackingConfig(n_pixels=32), torch.Generator()
    )
    tracker.start_frame(1, torch.from_numpy(sequence.T_world_camera[:1]).float())
    tracker.step()
    with HostTraffic() as traffic:
        tracker.loss(tracker._differentiable_pose(), *tracker.pixels).backward()
        torch.tensor(1.0).item()  # what the mode must see
    assert traffic.found == ["lift_fresh", "_local_scalar_dense"]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize(("name", "field_name"), [("sdf", "neus"), ("vr", "imap")])
def test_graphed_steps_track_as_plain_ones_do(name, field_name, sequence):
    device = torch.device("cuda")
    field = both(field_name)[0].to(device)
    paths = [
        track_sequence(
            name, field, sequence, StepBudget(6),
            replace(TrackingConfig(n_pixels=64), engine=engine), device=device,
        ).T_estimated
        for engine in ("plain", "fast")
    ]  # fmt: skip
    assert np.abs(paths[1] - paths[0])[:, :3, 3].max() < 1e-4


def test_many_frames_leave_no_memory_behind(sequence):
    """The engine's buffers and the tracker's tensors are the same ones after every frame."""
    sampler = PixelSampler(sequence, torch.device("cpu"))
    tracker = tracker_class("sdf")(
        both("neus")[0], sampler, TrackingConfig(n_pixels=16), torch.Generator()
    )
    T_start = torch.from_numpy(sequence.T_world_camera[:1]).float()

    def tensors_after(n_frames: int) -> int:
        for _ in range(n_frames):
            tracker.start_frame(1, T_start)
            tracker.step()
        gc.collect()
        return sum(issubclass(type(thing), torch.Tensor) for thing in gc.get_objects())

    after_few = tensors_after(10)
    assert tensors_after(190) <= after_few


def test_a_device_that_cannot_capture_goes_on_without(sequence, monkeypatch):
    """Catches a run that ends because of a driver, and one that says nothing of it."""

    def refuse(*arguments):
        raise RuntimeError("operation not permitted\nwhen stream is capturing")

    monkeypatch.setattr(base, "GraphedStep", refuse)
    sampler = PixelSampler(sequence, torch.device("cpu"))
    tracker = tracker_class("sdf")(
        both("neus")[0], sampler, TrackingConfig(n_pixels=16), torch.Generator()
    )
    tracker.is_graphed = True  # as on CUDA
    with pytest.warns(UserWarning, match="not captured as a CUDA graph: operation not permitted$"):
        tracker.start_frame(1, torch.from_numpy(sequence.T_world_camera[:1]).float())
    assert torch.isfinite(tracker.step())
