"""The engine: a frozen network and its derivatives as plain matrix products in reused memory.

Tracking asks a network whose weights stand still for values and for derivatives by position, ten
to eighty times a frame. Automatic differentiation answers with a graph that is built and thrown
away, fresh memory for every intermediate result, and passes over it that the caches do not hold.
Written out, the same mathematics is a list of matrix products into memory that stays:

    forward     a_l = h_l-1 W_l' + b_l,  h_l = act(a_l),  with e = sin(x B) entering layers 1 and 3
    backward    of a function with derivative g by the raw outputs y = h_4 W_y' + b_y:
                    g_4 = g W_y,          d_l = g_l * act'(a_l),
                    g_3 = d_4 W_4,        [g_2, s] = d_3 W_3,        g_1 = d_2 W_2,
                    dx = ((s + d_1 W_1) * cos(x B)) B'

Rows are taken in chunks whose intermediate results stay in a core's cache. `FourierMlp` under
torch's own differentiation is the readable reference; tests hold the engine to it.

A new activation needs its derivative once, in `PULL_BACKS`, and its in-place form beside it.
"""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nbtrack.fields.mlp import FourierMlp

_PADDED_TO = 16  # columns
_CHUNK_ROWS = 1024  # on CPUs: 1 MB a layer of 256 units


def silu_pull_back(gradient: Tensor, before: Tensor, out: Tensor) -> Tensor:
    """Gradient times the derivative of x sigmoid(x) at `before`."""
    return torch.ops.aten.silu_backward.grad_input(gradient, before, grad_input=out)


def relu_pull_back(gradient: Tensor, before: Tensor, out: Tensor) -> Tensor:
    """Gradient times the derivative of max(x, 0), which is 0 at 0."""
    return torch.ops.aten.threshold_backward.grad_input(gradient, before, 0, grad_input=out)


PULL_BACKS: dict[Callable[[Tensor], Tensor], Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    nn.functional.silu: silu_pull_back,
    nn.functional.relu: relu_pull_back,
}
"""For each activation: (gradient, input, out) -> gradient times the activation's derivative."""
_IN_PLACE = {
    nn.functional.silu: lambda before, out: torch.ops.aten.silu.out(before, out=out),
    nn.functional.relu: lambda before, out: torch.clamp(before, min=0, out=out),
}


class _Tape:
    """Memory for one pass over some rows: what the backward pass needs, and what it reuses."""

    def __init__(self, n_rows: int, mlp: "FrozenMlp") -> None:
        width, n_frequencies = mlp.width, mlp.n_frequencies

        def empty(n_columns: int) -> Tensor:
            return mlp.frequencies.new_empty(n_rows, n_columns)

        self.n_rows = n_rows
        self.phase = empty(n_frequencies)
        self.before = [empty(width) for _ in range(4)]
        self.parts: list[_Tape] | None = None

    def chunks(self, bounds: Sequence[tuple[int, int]]) -> list["_Tape"]:
        """The memory of parts of the rows, from where to where; made once, then kept."""
        if self.parts is None:
            self.parts = []
            for start, stop in bounds:
                part = copy.copy(self)
                part.n_rows = stop - start
                part.phase = self.phase[start:stop]
                part.before = [before[start:stop] for before in self.before]
                self.parts.append(part)
        return self.parts


class _Scratch:
    """Memory for what one chunk forgets again, for as many functions as are differentiated."""

    def __init__(self, n_rows: int, n_functions: int, mlp: "FrozenMlp") -> None:
        width, n_frequencies = mlp.width, mlp.n_frequencies

        def empty(n_rows: int, n_columns: int) -> Tensor:
            return mlp.frequencies.new_empty(n_rows, n_columns)

        self.hidden, self.joined = empty(n_rows, width), empty(n_rows, width + n_frequencies)
        all_rows = n_functions * n_rows
        self.first, self.second = empty(all_rows, width), empty(all_rows, width)
        self.both = empty(all_rows, width + n_frequencies)
        self.embedding = empty(all_rows, n_frequencies)
        self.cosine = empty(n_rows, n_frequencies)


class FrozenMlp(nn.Module):
    """A `FourierMlp` that is only asked: same answers, no graph inside, nothing allocated twice.

    It takes the network's place in a field (see `frozen`). Values are differentiable with respect
    to the points, once: the backward pass gives the memory free for the next forward pass.
    """

    def __init__(self, mlp: FourierMlp) -> None:
        super().__init__()
        self.width, n_frequencies = mlp.layer_1.weight.shape
        self.activation = mlp.activation
        self.metres_per_unit = mlp.metres_per_unit
        self.center = mlp.center
        # Products with 93 columns run at three quarters of the speed of those with 96: frequencies
        # of zero, which nothing looks at, fill the rest up.
        self.n_frequencies = -(-n_frequencies // _PADDED_TO) * _PADDED_TO
        pad = (0, self.n_frequencies - n_frequencies)
        frequencies = mlp.frequencies.detach() / mlp.metres_per_unit
        self.frequencies = nn.functional.pad(frequencies, pad)
        layers = (mlp.layer_1, mlp.layer_2, mlp.layer_3, mlp.layer_4, mlp.head)
        weights = [layer.weight.detach().clone() for layer in layers]
        for reads_embedding in (0, 2):
            weights[reads_embedding] = nn.functional.pad(weights[reads_embedding], pad)
        # Laid out for both directions; but products with few columns are faster transposed.
        self.weights = [weight.T.contiguous() for weight in weights[:4]] + [weights[4].T]
        self.weights_back = [weight.contiguous() for weight in weights]
        self.biases = [layer.bias.detach().clone() for layer in layers]
        self._kept: dict[tuple, Any] = {}
        self._free: list[_Tape] = []

    def forward(
        self, points_world: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Raw colour and the raw fourth output, as `FourierMlp.forward`."""
        raw = _Answer.apply(points_world, self)
        return raw[:, :3], raw[:, 3]

    @torch.no_grad()
    def linearize(
        self,
        points_world: Float[Tensor, "n 3"],
        slopes: Callable[[Float[Tensor, "m 4"]], Float[Tensor, "k m 4"]],
    ) -> tuple[Float[Tensor, "n 4"], Float[Tensor, "k n 3"]]:
        """Raw outputs and the spatial gradients (1/m) of k functions of them, chunk by chunk.

        Args:
            slopes: derivatives of the k functions with respect to the raw outputs, at these.
        """
        raw = points_world.new_empty(len(points_world), 4)
        gradients = []
        for start, stop in self._chunks(len(points_world)):
            tape = self._tape(stop - start)
            self._answer(points_world[start:stop], tape, out=raw[start:stop])
            gradients.append(self._pull_back(slopes(raw[start:stop]), tape))
        return raw, torch.cat(gradients, dim=1)

    def _answer(
        self, points_world: Float[Tensor, "m 3"], tape: _Tape, out: Float[Tensor, "m 4"]
    ) -> None:
        """Raw outputs of one chunk; leaves on the tape what `_pull_back` needs."""
        activate = _IN_PLACE[self.activation]
        scratch = self._scratch(tape.n_rows, 1)
        hidden, joined = scratch.hidden, scratch.joined
        embedding, hidden_2 = joined[:, self.width :], joined[:, : self.width]
        torch.mm(points_world - self.center, self.frequencies, out=tape.phase)
        torch.sin(tape.phase, out=embedding)
        inputs = (embedding, hidden, joined, hidden)
        outputs = (hidden, hidden_2, hidden, hidden)
        for layer in range(4):
            before = tape.before[layer]
            torch.addmm(self.biases[layer], inputs[layer], self.weights[layer], out=before)
            activate(before, outputs[layer])
        torch.addmm(self.biases[4], hidden, self.weights[4], out=out)

    def _pull_back(self, slopes: Float[Tensor, "k m 4"], tape: _Tape) -> Float[Tensor, "k m 3"]:
        """Spatial gradients (1/m) of k functions, from their derivatives by the raw outputs."""
        n_functions, n_rows = slopes.shape[:2]
        scratch = self._scratch(n_rows, n_functions)
        first, second, both = scratch.first, scratch.second, scratch.both
        back = self.weights_back
        torch.mm(slopes.flatten(0, 1), back[4], out=first)
        self._through(first, tape.before[3], first)
        torch.mm(first, back[3], out=second)
        self._through(second, tape.before[2], second)
        torch.mm(second, back[2], out=both)
        self._through(both[:, : self.width], tape.before[1], first)
        torch.mm(first, back[1], out=second)
        self._through(second, tape.before[0], second)
        torch.addmm(both[:, self.width :], second, back[0], out=scratch.embedding)
        torch.cos(tape.phase, out=scratch.cosine)
        by_function = scratch.embedding.view(n_functions, n_rows, -1)
        by_function.mul_(scratch.cosine)
        return torch.mm(scratch.embedding, self.frequencies.T).view(n_functions, n_rows, 3)

    def _through(self, gradient: Tensor, before: Tensor, out: Tensor) -> None:
        """A gradient through an activation, for one function or several at the same points."""
        n_functions = len(gradient) // max(len(before), 1)
        pull_back = PULL_BACKS[self.activation]
        if n_functions == 1:
            pull_back(gradient, before, out)
            return
        slope = pull_back(torch.ones_like(before), before, torch.empty_like(before))
        shape = (n_functions, *before.shape)
        torch.mul(gradient.unflatten(0, shape[:2]), slope, out=out.view(shape))

    def _chunks(self, n_rows: int) -> list[tuple[int, int]]:
        """Where chunks start and stop; a GPU takes all rows at once."""
        size = max(n_rows, 1) if self.frequencies.is_cuda else _CHUNK_ROWS
        return [(start, min(start + size, n_rows)) for start in range(0, n_rows, size)]

    def _tape(self, n_rows: int) -> _Tape:
        return self._keep(("tape", n_rows), lambda: _Tape(n_rows, self))

    def _take_tape(self, n_rows: int) -> _Tape:
        """A tape that nothing else uses until it is given back."""
        for index, tape in enumerate(self._free):
            if tape.n_rows == n_rows:
                return self._free.pop(index)
        return _Tape(n_rows, self)

    def _give_back(self, tape: _Tape) -> None:
        self._free = [*self._free[1 - _MOST_FREE :], tape]

    def _scratch(self, n_rows: int, n_functions: int) -> _Scratch:
        return self._keep(
            ("scratch", n_rows, n_functions), lambda: _Scratch(n_rows, n_functions, self)
        )

    def _keep(self, key: tuple, make: Callable[[], Any]) -> Any:
        if key not in self._kept:
            # Few sizes recur; frames with ever new numbers of points must not fill the memory.
            if len(self._kept) > _MOST_KEPT:
                self._kept.clear()
            self._kept[key] = make()
        return self._kept[key]


_MOST_KEPT, _MOST_FREE = 12, 4


class _Answer(torch.autograd.Function):
    """`FrozenMlp.forward` as one node of a graph, which holds a tape until its backward pass."""

    @staticmethod
    def forward(ctx: Any, points_world: Tensor, mlp: FrozenMlp) -> Tensor:
        n_rows = len(points_world)
        ctx.mlp, ctx.bounds = mlp, mlp._chunks(n_rows)
        if ctx.needs_input_grad[0]:
            ctx.tape = mlp._take_tape(n_rows)
            tapes = ctx.tape.chunks(ctx.bounds)
        else:
            tapes = [mlp._tape(stop - start) for start, stop in ctx.bounds]
        raw = points_world.new_empty(n_rows, 4)
        for (start, stop), tape in zip(ctx.bounds, tapes, strict=True):
            mlp._answer(points_world[start:stop], tape, out=raw[start:stop])
        return raw

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        if ctx.tape is None:
            raise RuntimeError("a frozen network's memory serves one backward pass only")
        result = gradient.new_empty(len(gradient), 3)
        for (start, stop), tape in zip(ctx.bounds, ctx.tape.chunks(ctx.bounds), strict=True):
            result[start:stop] = ctx.mlp._pull_back(gradient[None, start:stop], tape)[0]
        ctx.mlp._give_back(ctx.tape)
        ctx.tape = None
        return result, None


def frozen(field: nn.Module) -> nn.Module:
    """The field with its network on the engine; a field without such a network stays itself.

    The weights are those of now: later training does not reach the copy.
    """
    if not isinstance(getattr(field, "mlp", None), FourierMlp):
        return field
    asked = copy.copy(field)
    asked._modules = {**field._modules, "mlp": FrozenMlp(field.mlp)}
    return asked
