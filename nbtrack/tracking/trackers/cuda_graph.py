"""One optimisation step as a CUDA graph: hundreds of kernels, one launch.

The paper's steps cost 6 to 14 ms on its GPU whatever the number of pixels: they wait for kernels to
be launched one by one. A captured step is launched at once. It may copy nothing between host and
device and must find its inputs where they were when it was captured.
"""

from collections.abc import Callable

import torch
from torch import Tensor

_WARM_UPS = 3  # as torch's documentation asks for: libraries set themselves up in the first calls


class GraphedStep:
    """A step that was captured; calling it launches all of it.

    Source: torch's documentation of `torch.cuda.graph`, "whole-network capture".
    """

    def __init__(self, step: Callable[[], Tensor], generator: torch.Generator) -> None:
        """Run the step a few times, then capture it. The caller resets what that has changed.

        Args:
            step: works on tensors that stay where they are; returns the loss.
            generator: what the step draws from. Its state is as before when this returns.
        """
        state = generator.get_state()
        beside = torch.cuda.Stream()
        beside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(beside):
            for _ in range(_WARM_UPS):
                step()
        torch.cuda.current_stream().wait_stream(beside)
        self.graph = torch.cuda.CUDAGraph()
        self.graph.register_generator_state(generator)
        with torch.cuda.graph(self.graph):
            self.loss = step()
        generator.set_state(state)

    def __call__(self) -> Tensor:
        """Launch the step; returns its loss, in memory of its own."""
        self.graph.replay()
        return self.loss.clone()
