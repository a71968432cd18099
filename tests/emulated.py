"""An accelerator that every machine has: the CPU's numbers in tensors that say they lie elsewhere.

Every operation comes to Python, which runs it on the numbers inside. What fails on a GPU only, or
is slow there only, so shows everywhere: tensors of two devices in one operation, double precision
that a device lacks, waits, copies, and how many kernels a step launches.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

DEVICE = torch.device("meta")
WAITS = ("_local_scalar_dense", "nonzero", "masked_select", "_unique2", "equal")
# Launch nothing, beside views: memory is only taken, or given another shape.
FREE = (
    "empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided", "detach",
    "_unsafe_view",
)  # fmt: skip
TWO_KERNELS = ("slice_backward", "select_backward")  # zeros, and a copy into them


class There(torch.Tensor):
    """A tensor on the emulated device; `here` holds its numbers."""

    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, here):
        about = {"strides": here.stride(), "dtype": here.dtype, "device": DEVICE}
        made = torch.Tensor._make_wrapper_subclass(cls, here.size(), **about)
        made.here = here
        return made

    def tolist(self):
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(cls, operation, types, args=(), kwargs=None):
        return Emulator.now.__torch_dispatch__(operation, types, args, kwargs)


class Emulator(TorchDispatchMode):
    """Runs operations on the emulated device, and notes its kernels and the host's waits."""

    now: "Emulator"

    def __init__(self):
        super().__init__()
        self.kernels, self.waits, Emulator.now = Counter(), [], self

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        name, kwargs = operation._overloadpacket.__name__, dict(kwargs or {})
        tensors = [t for t in tree_leaves((args, kwargs)) if isinstance(t, torch.Tensor)]
        there = [t for t in tensors if isinstance(t, There)]
        is_there = bool(there)
        if kwargs.get("device") is not None:
            is_there = torch.device(kwargs["device"]).type == DEVICE.type
            kwargs["device"] = "cpu"
        self._note(operation, name, tensors, there, is_there)
        args, kwargs = tree_map_only(There, lambda t: t.here, (args, kwargs))
        known = {id(t.here): t for t in there}
        found = operation(*args, **kwargs)
        made = [t for t in tree_leaves(found) if isinstance(t, torch.Tensor)]
        # As Apple's GPUs, whose copies to the host change the type before they leave.
        if (there or is_there) and any(t.dtype == torch.float64 for t in made):
            raise TypeError(f"{name}: the device has no double precision")
        if not is_there:
            return found
        # What works in place gives back the tensor that it was given.
        return tree_map_only(
            torch.Tensor, lambda t: known[id(t)] if id(t) in known else There(t), found
        )

    def _note(self, operation, name, tensors, there, is_there):
        # Single numbers may come from the host, as on CUDA.
        is_mixed = there and any(t.dim() for t in tensors if not isinstance(t, There))
        if is_mixed and name != "copy_":
            raise RuntimeError(f"{name}: tensors on two devices")
        crosses = name == "copy_" and len(there) == 1
        crosses |= name == "_to_copy" and bool(there) != is_there
        if crosses or (there and name in WAITS):
            self.waits.append(name)
        if (there or is_there) and not operation.is_view and name not in FREE:
            self.kernels[name] += 1 + (name in TWO_KERNELS)


class Draws(torch.Generator):
    """A generator that may say that it is the emulated device's."""

    def __new__(cls, device="cpu"):
        made = super().__new__(cls)
        made.place = torch.device(device)
        return made

    @property
    def device(self):
        return self.place


def refuse(step: Callable, generator: torch.Generator) -> None:
    raise RuntimeError("cannot be recorded here")


def pretend(patch: pytest.MonkeyPatch, graph_of: Callable) -> None:
    """Steps are recorded on any device, in a way."""
    patch.setattr("nbtrack.core.capture.can_record", lambda device: True)
    patch.setattr("nbtrack.core.capture.run_aside", lambda step, device: step())
    patch.setattr("nbtrack.core.capture.graph_of", graph_of)


@contextmanager
def emulated() -> Iterator[Emulator]:
    """Within it `DEVICE` is there, and taken for CUDA, on which no step can be recorded."""
    adam, optimizer = (sys.modules[f"torch.optim.{name}"] for name in ("adam", "optimizer"))
    with pytest.MonkeyPatch.context() as patch:
        pretend(patch, refuse)
        patch.setattr("torch.Generator", Draws)
        patch.setattr("torch.accelerator.synchronize", lambda device: None)
        patch.setattr(adam, "_default_to_fused_or_foreach", lambda *_, **__: (False, True))
        patch.setattr(optimizer, "_get_fused_kernels_supported_devices", lambda: ["meta", "cpu"])
        with Emulator() as emulator:
            yield emulator


class Tape(TorchDispatchMode):
    """Operations and their results, in order; refuses what a CUDA recording refuses."""

    def __init__(self):
        super().__init__()
        self.done = []

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        if operation._overloadpacket.__name__ in WAITS:
            raise RuntimeError("operation not permitted when stream is capturing\nand more")
        found = operation(*args, **(kwargs or {}))
        self.done.append((operation, args, kwargs or {}, found))
        return found


def pretended_graph(step: Callable, generator: torch.Generator) -> Callable:
    """In place of `capture.graph_of`: replays a step's operations in the memory of the first time.

    So numbers that Python worked out, and tensors that were moved, stay as they were.
    """
    with Tape() as tape:
        result = step()

    @torch.no_grad()
    def replay():
        for operation, args, kwargs, found in tape.done:
            again = operation(*args, **kwargs)
            for old, new in zip(tree_leaves(found), tree_leaves(again), strict=True):
                if isinstance(old, torch.Tensor) and old.data_ptr() != new.data_ptr():
                    old.detach().copy_(new)
        return result

    return replay
