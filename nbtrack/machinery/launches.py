"""CUDA graphs: a GPU gets all kernels of a repeated step in one launch.

A step of tracking or mapping consists of a hundred kernels and more, each of some microseconds.
When Python launches them one by one, the GPU waits for Python. So CUDA records the kernels of a
step once, as a graph, and replays the graph in every later step. All steps must read and write the
same tensors.
"""

import threading
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from nbtrack.machinery.progress import tell

CALLS_BEFORE_RECORDING = 2
"""The first call loads and allocates; the last one tells whether the work can be recorded."""

_WATCHING = threading.Lock()
_WAITS = "called a synchronizing CUDA operation"  # in PyTorch's warning of a wait for the GPU


class RepeatedWork:
    """Does work by calling it; on CUDA, after a few calls, by replaying a recorded graph of it.

    The work must always read and write the same tensors, and draw random numbers from `generator`
    alone. A replay runs no Python, so anything else that the work depends on stays as it was when
    the graph was recorded. Work that waits for a value from the GPU, as for a shape that depends on
    values, cannot be recorded. It is called each time, and a message says so once.
    """

    def __init__(self, name: str, generator: torch.Generator) -> None:
        self.name = name
        self.generator = generator
        self.is_recordable = can_record(generator.device)
        self.n_calls = 0
        self.replay: Callable[[], None] | None = None

    def run(self, work: Callable[[], Tensor]) -> Tensor:
        """Do the work once, by a call or a replay, and return its result."""
        if not self.is_recordable:
            return work()
        self.n_calls += 1
        if self.n_calls <= CALLS_BEFORE_RECORDING:
            return self._watch(work)
        if self.replay is None:
            self.replay, self.result = record(work, self.generator)  # does not run the work yet
        self.replay()
        return self.result.clone()  # a copy, because the next replay overwrites the result

    def _watch(self, work: Callable[[], Tensor]) -> Tensor:
        """Call the work and return its result; mark it as not recordable if it waits for the GPU.

        Only the last call before the recording counts: the first one may wait, since it loads and
        allocates.
        """
        # `catch_warnings` changes a list of the whole process. Two threads in it at a time could
        # restore each other's lists, and warnings would stay caught for good.
        with _WATCHING, warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            torch.cuda.set_sync_debug_mode("warn")
            try:
                result = work()
            finally:
                torch.cuda.set_sync_debug_mode("default")
        waits = [warning for warning in caught if _WAITS in str(warning.message)]
        if waits and self.n_calls == CALLS_BEFORE_RECORDING:
            self.is_recordable = False
            where = f"{waits[0].filename}:{waits[0].lineno}"
            tell(f"nbtrack: {self.name} waits for a value of the GPU ({where}): not recorded, slow")
        return result


def can_record(device: torch.device) -> bool:
    """Whether work on a device can be recorded as a graph."""
    return device.type == "cuda"


def record(work: Callable[[], Tensor], generator: torch.Generator) -> tuple[Callable, Tensor]:
    """Record the work as a CUDA graph, without running it.

    Returns the function that replays it, and the tensor into which each replay writes the result.
    """
    graph = torch.cuda.CUDAGraph()
    graph.register_generator_state(generator)
    with torch.cuda.graph(graph):
        result = work()
    return graph.replay, result


def make_adam(groups: list[dict[str, Any]], device: torch.device) -> torch.optim.Adam:
    """Adam for groups of parameters, with learning rates as tensors so that a graph can read them.

    `groups` are PyTorch's dictionaries with "params" and a number "lr". On a CPU the rates are in
    double precision, as Python's numbers are; CUDA's fused kernel takes single precision.
    """
    is_recorded = can_record(device)
    like = {"dtype": torch.float32 if is_recorded else torch.float64, "device": device}
    groups = [{**group, "lr": torch.tensor(group["lr"], **like)} for group in groups]
    return torch.optim.Adam(groups, fused=is_recorded, capturable=is_recorded)
