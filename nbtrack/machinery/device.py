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

# Below this width of a network (units a layer) its matrix products are too small to share among
# threads: on two cores, two threads were slower than one. The cores are then used by processes,
# which handle several rooms and methods side by side.
_WIDTH_FOR_THREADS = 192
# A forked child would wait for ever for the OpenMP threads of its parent, which it does not have.
# With one thread it waits for none.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))


def choose_device() -> torch.device:
    """Choose the device that computes.

    It is the one that the environment variable `NBTRACK_DEVICE` names. Without this variable it is
    the machine's accelerator, or the CPU of a machine that has none. Raises ConfigError, which
    lists the devices of this machine, if the named one is unknown or not there.
    """
    accelerator = torch.accelerator.current_accelerator(check_available=True)
    name = os.environ.get("NBTRACK_DEVICE")
    if not name:
        return accelerator or torch.device("cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()  # raises on `meta`, too, whose tensors have no values
    except (RuntimeError, AssertionError, NotImplementedError, ImportError):
        count = torch.accelerator.device_count()
        devices = ", ".join(["cpu", *(f"{accelerator}:{i}" for i in range(count))])
        raise ConfigError(f"no device {name!r:.80}: this machine has {devices}") from None
    return device


@cache
def constant(numbers: tuple, device: torch.device, dtype: torch.dtype) -> Tensor:
    """A tensor of the numbers on a device; equal calls return the same tensor.

    A copy to a GPU waits until the GPU has done its work, so steps of a loop must not make one.
    The tensor is made outside of inference mode, because autograd refuses tensors made inside.
    """
    with torch.inference_mode(False):
        return torch.tensor(numbers, dtype=dtype, device="cpu").to(device)


def device_name(device: torch.device) -> str:
    """The name of a device for results: the GPU's, or the processor's with its usable cores."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    if device.type == "mps":
        return f"Apple GPU ({platform.machine()})"
    name = platform.processor() or platform.machine()
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as lines:
        models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
        name = next(models, name)  # the file has a line for each core; the first is enough
    return f"{name}, {usable_cores()} cores"


def usable_cores() -> int:
    """How many CPU cores this process may use; a scheduler may allow fewer than there are."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def usual_modes() -> Iterator[None]:
    """Run a block with gradients, without autocast, and with the CPU as the default device.

    A program that calls this package may have set other modes; they are restored after the block.
    The default dtype stays as it is, because it holds for all threads of the process. For this
    reason the package names the dtype wherever it makes a tensor.
    """
    is_usual = torch.get_default_device().type == "cpu"
    with (
        # The context of a device slows every call of PyTorch, so it is left out where it can be.
        contextlib.nullcontext() if is_usual else torch.device("cpu"),
        torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False),
        torch.inference_mode(False), torch.enable_grad(),
    ):  # fmt: skip
        yield


def threads(number: int) -> contextlib.AbstractContextManager[None]:
    """Run a block with this number of CPU threads."""
    return _changed("num_threads", number)


@contextlib.contextmanager
def _changed(name: str, value: Any) -> Iterator[None]:
    """Run a block with the global setting `name` of PyTorch at `value`; restore it afterwards.

    If the setting has this value already, nothing is set or restored. The value may come from a
    block that runs in another thread, and that block will restore the original.
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
    """Run a block with the CPU threads and the precision of matrix products that suit a network.

    A network with layers of few units (`width`) gets one thread, since sharing its small matrix
    products takes longer than it saves. A wide one gets as many as the process already has. Matrix
    products have full single precision or, with `tf32`, TF32. Only NVIDIA's GPUs have TF32, which
    keeps 10 of the mantissa's 23 bits and takes less time.
    """
    number = 1 if width < _WIDTH_FOR_THREADS else torch.get_num_threads()
    precision = "high" if tf32 else "highest"  # PyTorch's names of TF32 and single precision
    with threads(number), _changed("float32_matmul_precision", precision):
        yield


def has_room_for(device: torch.device, n_bytes: int) -> bool:
    """Whether a GPU has room for `n_bytes` of data and as much again for the work on them.

    Always true for the CPU and for Apple's GPUs, which use the memory that the data are in already.
    """
    if device.type != "cuda":
        return True
    free_bytes, _ = torch.cuda.mem_get_info(device)
    # PyTorch's allocator holds memory in reserve, which the driver does not count as free.
    unused_bytes = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return 2 * n_bytes < free_bytes + unused_bytes


@contextlib.contextmanager
def advise_on_memory(setting: str) -> Iterator[None]:
    """Run a block; if the device or the host runs out of memory in it, raise OutOfMemory.

    `setting` tells in the message what to lower, with its present value, as
    "tables.pixels.vr=1024".
    """
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        # The RuntimeErrors of CUDA, the CPU's allocator and MPS are known by their texts.
        words = ("can't allocate memory", "not enough memory", "out of memory")
        lacks_memory = isinstance(error, MemoryError) or any(word in str(error) for word in words)
        # An OutOfMemory comes from an inner `advise_on_memory`, which has named its own setting.
        if isinstance(error, OutOfMemory) or not lacks_memory:
            raise
        advice = "lower it with --set, or take fewer frames, as with --frames ::2"
        raise OutOfMemory(f"out of memory with {setting}: {advice}") from None


def synchronize(device: torch.device) -> None:
    """Wait until everything queued on the device is done, so that a clock reading means it."""
    if device.type != "cpu":
        torch.accelerator.synchronize(device)
