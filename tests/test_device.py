"""Choosing a device, its memory."""

import pytest
import torch

from nbtrack.core.device import advise_on_memory, choose_device, has_room_for
from nbtrack.core.errors import ConfigError, OutOfMemory


def test_a_named_device_is_taken_or_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a silent fall-back to the CPU where the named GPU is not there."""
    monkeypatch.setenv("NBTRACK_DEVICE", "cpu")
    assert choose_device() == torch.device("cpu")
    for name in ("cuda:99", "gpu"):
        monkeypatch.setenv("NBTRACK_DEVICE", name)
        with pytest.raises(ConfigError, match=rf"device '{name}' is not there: .* has cpu"):
            choose_device()


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


def test_host_memory_is_not_asked_twice() -> None:
    """Catches images that are copied on a CPU, where they already are."""
    assert has_room_for(torch.device("cpu"), 2**60)
