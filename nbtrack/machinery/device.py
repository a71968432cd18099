"""Which device does the work, and with how many threads."""

import contextlib
import os
import platform
from collections.abc import Iterator
from functools import cache
from typing import Any

import torch
from torch import Tensor

from nbtrack.machinery.errors import ConfigError, OutOfMemory

# Below this width matrix products are too small to share: on two cores, two threads were slower
# than one. Rooms and methods then run side by side in processes instead.
_WIDTH_FOR_THREADS = 192
if hasattr(os, "register_at_fork"):  # a child has none of OpenMP's threads, and would wait for them
    os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))


def choose_device() -> torch.device:
    """The device that `NBTRACK_DEVICE` names, else the accelerator there is, else the CPU.

    Raises ConfigError, saying what there is, if the named device is unknown, or not there.
    """
    accelerator = torch.accelerator.current_accelerator(check_available=True)
    name = os.environ.get("NBTRACK_DEVICE")
    if not name:
        return accelerator or torch.device("cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()  # raises on `meta`, too, whose tensors have no values
    except (RuntimeError, AssertionError, NotImplementedError, ImportError):
        devices = ["cpu", *(f"{accelerator}:{i}" for i in range(torch.accelerator.device_count()))]
        raise ConfigError(f"no device {name!r}: this machine has {', '.join(devices)}") from None
    return device


@cache
def constant(numbers: tuple, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Numbers on a device, copied there once: in every step a copy would wait for the device.

    They are made outside of inference mode, whose tensors would serve no gradient later.
    """
    with torch.inference_mode(False):
        return torch.tensor(numbers, dtype=dtype, device="cpu").to(device)


def device_name(device: torch.device) -> str:
    """What to call the device in results: the GPU's name, or the processor's and its cores."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    if device.type == "mps":
        return f"Apple GPU ({platform.machine()})"
    name = platform.processor() or platform.machine()
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as lines:
        models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
        name = next(models, name)  # the first core's
    return f"{name}, {usable_cores()} cores"


def usable_cores() -> int:
    """The CPU cores that this process may use; a scheduler may leave it fewer than there are."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def usual_modes() -> Iterator[None]:
    """Run a block with gradients, without autocast, on the CPU where no device is named.

    A program that calls this package may have set other modes, which hold again after the block.
    The default dtype is not among them: it is one of the whole process, not of the thread. Dtypes
    are named where tensors are made.
    """
    is_usual = torch.get_default_device().type == "cpu"  # then no context, which slows every call
    with (
        contextlib.nullcontext() if is_usual else torch.device("cpu"),
        torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False),
        torch.inference_mode(False), torch.enable_grad(),
    ):  # fmt: skip
        yield


def matrix_products(tf32: bool) -> contextlib.AbstractContextManager[None]:
    """Run a block with matrix products in single precision, or on NVIDIA's GPUs in TF32.

    TF32 keeps 10 of the mantissa's 23 bits, and is several times as fast.
    """
    return _changed("float32_matmul_precision", "high" if tf32 else "highest")


def threads(number: int) -> contextlib.AbstractContextManager[None]:
    """Run a block with so many CPU threads."""
    return _changed("num_threads", number)


@contextlib.contextmanager
def _changed(name: str, value: Any) -> Iterator[None]:
    """Run a block with a global setting of PyTorch at another value, and restore it afterwards.

    Where the setting has that value already, perhaps by the block of another thread, nothing is set
    or restored. So of two such blocks the first to begin restores what was before both.
    """
    getter, setter = getattr(torch, f"get_{name}"), getattr(torch, f"set_{name}")
    before = getter()
    if before == value:
        yield
        return
    setter(value)
    try:
        yield
    finally:
        setter(before)


@contextlib.contextmanager
def suited_to(width: int, tf32: bool) -> Iterator[None]:
    """Run a block with `matrix_products`, and the number of CPU threads that suits a network.

    Narrow networks get one, since sharing their small matrix products takes longer than it saves;
    wide ones get as many as the process already has.
    """
    number = 1 if width < _WIDTH_FOR_THREADS else torch.get_num_threads()
    with threads(number), matrix_products(tf32):
        yield


def has_room_for(device: torch.device, n_bytes: int) -> bool:
    """Whether a GPU can hold `n_bytes` more and then still has as much free for the work itself."""
    if device.type != "cuda":
        return True  # the CPU's and Apple's memory is the one that the data are in already
    free_bytes, _ = torch.cuda.mem_get_info(device)
    # What torch's allocator keeps without using it is free as well.
    unused_bytes = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return 2 * n_bytes < free_bytes + unused_bytes


@contextlib.contextmanager
def advise_on_memory(setting: str) -> Iterator[None]:
    """Turn running out of memory, the device's or the host's, into an OutOfMemory in one line.

    It names the setting to lower: what decides on the memory, with its present value.
    """
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        # The RuntimeErrors of CUDA, the CPU's allocator and MPS are known by their texts.
        words = ("can't allocate memory", "not enough memory", "out of memory")
        lacks_memory = isinstance(error, MemoryError) or any(word in str(error) for word in words)
        # An OutOfMemory comes from a block within this one, which has named its own setting.
        if isinstance(error, OutOfMemory) or not lacks_memory:
            raise
        advice = "lower it with --set, or take fewer frames, as with --frames ::2"
        raise OutOfMemory(f"out of memory with {setting}: {advice}") from None


def synchronize(device: torch.device) -> None:
    """Wait until everything queued on the device is done, so that a clock reading means it."""
    if device.type != "cpu":
        torch.accelerator.synchronize(device)
