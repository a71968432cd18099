"""Work that is repeated on tensors which keep their place: launched on a GPU in one go.

A step of tracking or mapping consists of a hundred kernels and more, each of some microseconds.
Launched from Python one by one they keep a GPU waiting. CUDA records them once, as a graph.
"""

import threading
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from nbtrack.machinery.progress import tell

CALLS_BEFORE_RECORDING = 2
"""The first call loads and allocates; the second one is watched for what cannot be recorded."""

_WATCHING = threading.Lock()
_WAITS = "called a synchronizing CUDA operation"  # how PyTorch warns of it


class Recording:
    """Calls work; on CUDA it records the work after a few calls, and replays it from then on.

    The work always reads and writes the same tensors, and draws from one generator. A replay runs
    no Python: anything else that the work depends on stays as it was at the recording. Work that
    waits for a value of the device, as shapes that depend on values do, cannot be recorded; it is
    called each time, and a message says so once.
    """

    def __init__(self, name: str, generator: torch.Generator) -> None:
        self.name = name
        self.generator = generator
        self.is_recordable = can_record(generator.device)
        self.n_calls = 0
        self.replay: Callable[[], None] | None = None

    def run(self, work: Callable[[], Tensor]) -> Tensor:
        """Do the work once, by a call or a replay; returns its result."""
        if not self.is_recordable:
            return work()
        self.n_calls += 1
        if self.n_calls <= CALLS_BEFORE_RECORDING:
            return self._watch(work)
        if self.replay is None:
            self.replay, self.result = record(work, self.generator)  # which runs nothing yet
        self.replay()
        return self.result.clone()  # the next replay writes over it

    def _watch(self, work: Callable[[], Tensor]) -> Tensor:
        """Call the work; if it waits for the device in the last of these calls, it is not recorded.

        The first call may wait, since it loads and allocates.
        """
        # Warnings are caught in the whole process: one thread at a time, or some are lost for good.
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
    """Whether launches on a device can be recorded."""
    return device.type == "cuda"


def record(work: Callable[[], Tensor], generator: torch.Generator) -> tuple[Callable, Tensor]:
    """Record the work without running it: what replays it, and where its result will then lie."""
    graph = torch.cuda.CUDAGraph()
    graph.register_generator_state(generator)
    with torch.cuda.graph(graph):
        result = work()
    return graph.replay, result


def make_adam(groups: list[dict[str, Any]], device: torch.device) -> torch.optim.Adam:
    """Adam whose state and learning rates are tensors that keep their place.

    Learning rates are in double precision on a CPU, as Python's numbers would be; CUDA's fused
    kernel takes single precision.
    """
    is_recorded = can_record(device)
    like = {"dtype": torch.float32 if is_recorded else torch.float64, "device": device}
    groups = [{**group, "lr": torch.tensor(group["lr"], **like)} for group in groups]
    return torch.optim.Adam(groups, fused=is_recorded, capturable=is_recorded)
