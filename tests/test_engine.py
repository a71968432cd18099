"""The network's answers in parts, what a step leaves behind, and a device without memory."""

import gc
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from box_room import walk
from test_fields import points_inside

from nbtrack.core.bounds import SceneBounds
from nbtrack.fields import Field, NetworkSettings, make_field, mlp
from nbtrack.machinery.device import advise_on_memory
from nbtrack.machinery.errors import OutOfMemory
from nbtrack.tracking import SdfSettings, StepBudget, make_tracker

BOUNDS = SceneBounds((-2.0, -1.0, -1.0), (2.0, 1.0, 2.0))


def frozen_field(name: str) -> Field:
    return make_field(name, NetworkSettings(width=32), BOUNDS, seed=3).requires_grad_(False)


@pytest.mark.parametrize("name", ["imap", "neus"])
def test_parts_answer_as_the_whole(name: str, monkeypatch) -> None:
    """Catches a part that is lost, and training in parts, whose sums would be rounded otherwise."""
    field, found, rows = frozen_field(name), [], []
    field.mlp.layer_1.register_forward_hook(lambda *call: rows.append(len(call[2])))
    for layer_size in (2**18, 32 * 10):
        monkeypatch.setattr(mlp, "_LAYER_SIZE", layer_size)
        points = points_inside(BOUNDS, 37).requires_grad_()
        color, value = field(points)
        found.append((color, value, *torch.autograd.grad(color.sum() + value.sum(), points)))
    field.requires_grad_(True)(points)
    assert rows == [37, 10, 10, 10, 7, 37]
    for whole, parts in zip(*found, strict=True):
        torch.testing.assert_close(parts, whole, rtol=1e-4, atol=1e-5)


def test_many_frames_leave_no_memory_behind() -> None:
    """Catches tensors that a tracker keeps of every frame."""
    settings, frame, counts = SdfSettings(n_pixels=16), walk(2)[1], []
    tracker = make_tracker("sdf", frozen_field("neus"), np.eye(4), StepBudget(1), settings)
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


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no processes by fork here")
def test_a_child_by_fork_computes() -> None:
    """Catches a child, such as a loader's or a server's, that waits for ever for threads that its
    parent has used and that it does not have."""
    code = (
        "import os, signal, sys, torch; from nbtrack.machinery import device\n"
        "torch.set_num_threads(2)\n"
        "work = lambda: torch.rand(1000, 1000).exp().sum()\n"
        "work()\n"
        "if child := os.fork(): sys.exit(os.waitpid(child, 0)[1] != 0)\n"
        "signal.alarm(10), work(), os._exit(0)\n"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
