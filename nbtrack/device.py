"""Which device does the work, and with how many threads."""

import contextlib
import os
import platform
from collections.abc import Iterator

import torch

# Below this width matrix products are too small to share: on two cores, two threads were slower
# than one. Rooms and methods then run side by side in processes instead.
_WIDTH_FOR_THREADS = 192


def choose_device() -> torch.device:
    """The first there is of CUDA, Apple's MPS and the CPU."""
    if torch.cuda.is_available():
        return torch.device("cuda")
    if torch.backends.mps.is_available():
        return torch.device("mps")
    return torch.device("cpu")


def device_name(device: torch.device) -> str:
    """What to call the device in results: the GPU's name, or the processor's and its cores."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    if device.type == "mps":
        return f"Apple GPU ({platform.machine()})"
    return f"{_processor_name()}, {os.cpu_count()} cores"


@contextlib.contextmanager
def suitable_threads(width: int) -> Iterator[None]:
    """Run a block with the number of CPU threads that suits a network's width.

    Narrow networks get one, wide ones as many as the process already has.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1 if width < _WIDTH_FOR_THREADS else before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def synchronize(device: torch.device) -> None:
    """Wait until everything queued on the device is done, so that a clock reading means it."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    elif device.type == "mps":
        torch.mps.synchronize()


def _processor_name() -> str:
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as lines:
        for line in lines:
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
