"""Steps recorded as a CUDA graph: one launch in place of hundreds, for which a GPU would wait."""

from collections.abc import Callable
from typing import Any

import torch

from nbtrack.core.arrays import Scalar
from nbtrack.core.progress import tell

WARM_STEPS = 3  # before a recording: libraries load, and constants are copied, which none can hold


def can_record(device: torch.device) -> bool:
    """Whether steps on a device can be recorded."""
    return device.type == "cuda"


class Recorded:
    """A step that runs as it is for `WARM_STEPS` calls, is then recorded, and from there replayed.

    A replay works in the same memory: what changes between calls must be copied into tensors that
    stay; only numbers drawn from the owner's generator are new. Where recording fails, a line says
    so, and the step goes on as it is.
    """

    def __init__(self, step: Callable[[], Scalar], owner: Any) -> None:
        """Record a step that draws random numbers from the owner's `generator`, on its device."""
        self._run, self._owner, self._calls = step, owner, 0

    def __call__(self) -> Scalar:
        """Run the step. Its result is a copy that later calls do not change."""
        self._calls += 1
        if self._calls <= WARM_STEPS:
            return run_aside(self._run, self._owner.generator.device)
        if self._calls == WARM_STEPS + 1:
            self._record()
        return self._run().clone()

    def _record(self) -> None:
        generator = self._owner.generator
        state = generator.get_state()
        try:
            self._run = graph_of(self._run, generator)
        except RuntimeError as error:
            # A generator that was in a failed recording may stay in it.
            self._owner.generator = torch.Generator(generator.device)
            reason = str(error).partition("\n")[0]
            tell(f"nbtrack: this step cannot be recorded ({reason}): its kernels go one by one")
        self._owner.generator.set_state(state)


def run_aside(step: Callable[[], Scalar], device: torch.device) -> Scalar:
    """Run a step on a stream of its own, as those must be that are recorded afterwards."""
    with torch.cuda.device(device):
        aside, stream = torch.cuda.Stream(), torch.cuda.current_stream()
        aside.wait_stream(stream)
        with torch.cuda.stream(aside):
            result = step()
        stream.wait_stream(aside)
    return result


def graph_of(step: Callable[[], Scalar], generator: torch.Generator) -> Callable[[], Scalar]:
    """Record a step, which does not run it; RuntimeError where it waits, copies or lacks memory."""
    with torch.cuda.device(generator.device):
        graph, stream = torch.cuda.CUDAGraph(), torch.cuda.current_stream()
        graph.register_generator_state(generator)
        try:
            with torch.cuda.graph(graph, stream=torch.cuda.Stream()):
                result = step()
        finally:
            torch.cuda.set_stream(stream)  # a failed recording leaves its own

    def replay() -> Scalar:
        graph.replay()
        return result

    return replay
