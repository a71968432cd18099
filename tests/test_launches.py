"""Steps that are recorded and replayed: on a GPU, if any, and with a tape in place of its graph.

The tape keeps the operations of one call and does them again into the same memory, so that whatever
a step takes from elsewhere, or reads on the host, is seen here as on a GPU.
"""

import gc
import warnings
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import torch
from box_room import walk
from test_fields import points_inside
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from nbtrack.beyond.lm import LmTracker
from nbtrack.core.bounds import SceneBounds
from nbtrack.fields import Field, NetworkSettings, NeusMapping, field_class, make_field, mlp
from nbtrack.machinery import launches
from nbtrack.machinery.device import advise_on_memory
from nbtrack.machinery.errors import DataError, OutOfMemory
from nbtrack.machinery.files import naming_damaged
from nbtrack.mapping.fit import _Fit
from nbtrack.tracking import AdamTracker, SdfTracker, StepBudget, VrTracker, track_sequence

BOUNDS = SceneBounds((-1.2, -1.0, -1.4), (1.2, 1.0, 1.4))
WAITS = "_local_scalar_dense", "nonzero", "masked_select", "is_nonzero"
SEQUENCE = walk(5)
SEQUENCE.depths_mm[2, :20] = 0  # frames differ in what they measure
SEQUENCE.depths_mm[3, :, 9:] = 0


class Tape(TorchDispatchMode):
    """The operations of a call. They are done as they are recorded, so not at the first replay."""

    def __init__(self) -> None:
        super().__init__()
        self.calls, self.n_replays = [], 0

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        result = operation(*args, **(kwargs or {}))
        self.calls.append((operation, args, kwargs or {}, result))
        return result

    @torch.no_grad()
    def replay(self) -> None:
        """Do them again, into the memory of their results."""
        self.n_replays += 1
        for operation, args, kwargs, result in self.calls if self.n_replays > 1 else []:
            again = operation(*args, **kwargs)
            for old, new in zip(tree_leaves(result), tree_leaves(again), strict=True):
                if isinstance(old, torch.Tensor) and not shares_memory(old, new):
                    old.detach().copy_(new)


def shares_memory(a: torch.Tensor, b: torch.Tensor) -> bool:
    return a.untyped_storage().data_ptr() == b.untyped_storage().data_ptr()


class Waits(TorchDispatchMode):
    """Warns of what would wait for a GPU, as PyTorch does."""

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        if any(name in str(operation) for name in WAITS):
            warnings.warn("called a synchronizing CUDA operation", stacklevel=2)
        return operation(*args, **(kwargs or {}))


def on_tape(work, generator: torch.Generator):
    with Tape() as tape:
        result = work()
    return tape.replay, result


def by_calls(work, generator: torch.Generator):
    result = torch.empty(())
    return lambda: result.set_(work()), result


@pytest.fixture
def as_on_a_gpu(monkeypatch) -> None:
    watching = ExitStack()
    modes = {"warn": lambda: watching.enter_context(Waits()), "default": watching.close}
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", lambda mode: modes[mode]())
    monkeypatch.setattr(launches, "can_record", lambda device: True)


@pytest.fixture
def both_ways(as_on_a_gpu, monkeypatch):
    """What some work gives on tape, and by calls."""

    def found(work, *arguments):
        for record in (on_tape, by_calls):
            monkeypatch.setattr(launches, "record", record)
            yield work(*arguments)

    return found


class Own(AdamTracker):
    """What a user may write: distances alone, in quarters of a metre."""

    name, Settings = "own", SdfTracker.Settings

    def loss(self, T_world_camera, directions_camera, color, depth):
        points_camera = directions_camera * depth[:, None]
        points_world = points_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        return (4 * self.field(points_world)[1]).square().mean()


class Choosy(Own):
    """Looks at values on the host: near points alone, however many they are."""

    def loss(self, T_world_camera, directions_camera, color, depth):
        near = (depth < 1.2).nonzero()[:, 0]
        return super().loss(T_world_camera, directions_camera[near], color[near], depth[near])


CPU = torch.device("cpu")


def tracked(kind: type, field_name: str, device: torch.device = CPU) -> np.ndarray:
    field = make_field(field_name, NetworkSettings(width=16), BOUNDS, seed=3).to(device)
    tracker = kind(field, SEQUENCE.T_world_camera[0], StepBudget(4), kind.Settings(n_pixels=24))
    return track_sequence(tracker, SEQUENCE).T_estimated


FIELDS = ("imap", "neus", "neus_plus")
PAIRS = (SdfTracker, "neus"), (VrTracker, "imap"), (VrTracker, "neus"), (Own, "neus")


@pytest.mark.parametrize(("kind", "field_name"), PAIRS)
def test_a_replayed_step_is_the_step(kind: type, field_name: str, both_ways) -> None:
    """Catches a step that keeps the pixels, images, moments or random numbers of the recording, and
    one that reads a value on the host."""
    replayed, called = both_ways(tracked, kind, field_name)
    np.testing.assert_array_equal(replayed, called)
    assert np.abs(np.diff(replayed, axis=0)).max(axis=(1, 2)).min() > 1e-4  # each frame moves


def totals(name: str, device: torch.device = CPU) -> list[float]:
    """Losses of some iterations."""
    extra = {"n_surface_points": 8} if name == "neus_plus" else {}
    settings = field_class(name).Settings(iterations=12, n_rays=16, **extra)
    field = make_field(name, NetworkSettings(width=16), BOUNDS, seed=3).to(device)
    fit = _Fit({"seed": 0}, settings, field, SEQUENCE, np.arange(5))
    fit._advance(range(12))
    return [row["total"] for row in fit.history]


@pytest.mark.parametrize("name", FIELDS)
def test_a_replayed_iteration_is_the_iteration(name: str, both_ways) -> None:
    """Catches a batch or a learning rate that stays, values read on the host, and a loss that the
    next replay writes over."""
    replayed, called = both_ways(totals, name)
    assert replayed == called
    assert len(set(replayed)) == 12


def test_what_waits_is_called(as_on_a_gpu, capsys, monkeypatch) -> None:
    """Catches a loss that cannot be recorded and is; and one that is told of at every step."""
    monkeypatch.setattr(launches, "record", None)
    tracked(Choosy, "neus")
    assert capsys.readouterr().err.count("tracker own waits for a value of the GPU") == 1


@pytest.fixture
def cuda() -> torch.device:
    if not torch.cuda.is_available():
        pytest.skip("no GPU")
    return torch.device("cuda")


@pytest.mark.gpu
@pytest.mark.parametrize(("kind", "field_name"), [*PAIRS, (LmTracker, "neus")])
def test_a_gpu_tracks_as_a_cpu(kind: type, field_name: str, cuda, monkeypatch) -> None:
    """Catches tensors left on the host, double precision that a device lacks, other poses than a
    few steps from the start can reach, and recorded steps that draw other numbers."""
    recorded = tracked(kind, field_name, cuda)
    np.testing.assert_allclose(recorded, tracked(kind, field_name), atol=0.02)  # of other pixels
    monkeypatch.setattr(launches, "CALLS_BEFORE_RECORDING", 1_000_000)
    np.testing.assert_allclose(recorded, tracked(kind, field_name, cuda), atol=1e-5)


@pytest.mark.gpu
@pytest.mark.parametrize("name", FIELDS)
def test_a_gpu_maps_what_it_has_recorded(name: str, cuda, monkeypatch) -> None:
    """Catches recorded iterations that draw other numbers, keep what changes, or are not finite."""
    recorded = totals(name, cuda)
    monkeypatch.setattr(launches, "CALLS_BEFORE_RECORDING", 1_000_000)
    np.testing.assert_allclose(recorded, totals(name, cuda), rtol=1e-3)
    assert np.isfinite(recorded).all()


def test_a_map_goes_on_only_where_it_began(tmp_path: Path) -> None:
    """Catches a checkpoint from another kind of device that is called damaged."""
    settings, checkpoint = NeusMapping(iterations=2, n_rays=16), tmp_path / "mapping.pt"
    field = make_field("neus", NetworkSettings(width=16), BOUNDS, seed=3)
    fit = _Fit({"seed": 0}, settings, field, SEQUENCE, np.arange(5))
    fit.run(checkpoint, lambda *_: None)
    fit.recipe["device"] = "cuda"
    with pytest.raises(DataError, match=r"mapping.pt was made with another device:"):
        fit.run(checkpoint, lambda *_: None)


@pytest.mark.parametrize("kind", [torch.OutOfMemoryError, torch.AcceleratorError])
def test_a_device_that_fails_is_no_damage(kind: type, tmp_path: Path) -> None:
    """Catches the advice to delete a sound file because a GPU was full."""
    with pytest.raises(kind), naming_damaged(tmp_path):
        raise kind("CUDA error: out of memory")


OBLONG = SceneBounds((-2.0, -1.0, -1.0), (2.0, 1.0, 2.0))


def frozen_field(name: str) -> Field:
    return make_field(name, NetworkSettings(width=32), OBLONG, seed=3).requires_grad_(False)


@pytest.mark.parametrize("name", ["imap", "neus"])
def test_parts_answer_as_the_whole(name: str, monkeypatch) -> None:
    """Catches a part that is lost, and training in parts, whose sums would be rounded otherwise."""
    field, found, rows = frozen_field(name), [], []
    field.mlp.layer_1.register_forward_hook(lambda *call: rows.append(len(call[2])))
    for layer_size in (2**18, 32 * 10):
        monkeypatch.setattr(mlp, "_LAYER_SIZE", layer_size)
        points = points_inside(OBLONG, 37).requires_grad_()
        color, value = field(points)
        found.append((color, value, *torch.autograd.grad(color.sum() + value.sum(), points)))
    field.requires_grad_(True)(points)
    assert rows == [37, 10, 10, 10, 7, 37]
    for whole, parts in zip(*found, strict=True):
        torch.testing.assert_close(parts, whole, rtol=1e-4, atol=1e-5)


def test_many_frames_leave_no_memory_behind() -> None:
    """Catches tensors that a tracker keeps of every frame."""
    settings, frame, counts = SdfTracker.Settings(n_pixels=16), walk(2)[1], []
    tracker = SdfTracker(frozen_field("neus"), np.eye(4), StepBudget(1), settings)
    for n_frames in (2, 5):
        for _ in range(n_frames):
            tracker.restart(np.eye(4))
            tracker.track(frame)
        gc.collect()
        counts.append(sum(issubclass(type(thing), torch.Tensor) for thing in gc.get_objects()))
    assert counts[1] <= counts[0]


def test_running_out_of_memory_names_the_setting() -> None:
    """Catches a page of torch's allocator in place of one line; the allocation here is real."""
    with (
        pytest.raises(OutOfMemory, match=r"out of memory with mapping.neus.n_rays=9: lower it"),
        advise_on_memory("mapping.neus.n_rays=9"),
    ):
        torch.empty(2**55)
    with pytest.raises(OutOfMemory), advise_on_memory("x"):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB")
    # A wrong shape is no lack of memory.
    with pytest.raises(RuntimeError, match="size of tensor"), advise_on_memory("x"):
        torch.ones(2) + torch.ones(3)
