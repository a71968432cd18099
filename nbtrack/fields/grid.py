"""A field baked into a dense grid: sampled once, then answered by trilinear interpolation.

A network costs 250,000 products a point, the grid one row of memory. The interpolant is continuous;
its gradient is exact, and jumps from cell to cell. Computations keep the points on the last axis:
torch is slow where the last axis is short.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nbtrack.core.arrays import Colors, Indices, Points, Values
from nbtrack.core.errors import ConfigError
from nbtrack.fields.base import LUMA, Field, Linearization

_POINTS_AT_ONCE = 65_536
_MAX_BYTES = 1_000_000_000
# A vertex holds its colour (3 floats) and, for the cell that starts there, value and intensity
# of all 8 corners: 8 times the memory of the samples, but one cache line a query, not 4 to 8.
_BYTES_PER_VERTEX = 4 * (3 + 2 * 8)


class BakedField(Field):
    """A frozen copy of another field on a regular grid over its bounds. Our choice.

    Points outside are moved to its border: along such an axis the gradient is 0.
    """

    name = "baked"

    @torch.no_grad()
    def __init__(self, source: Field, voxel: float | int) -> None:
        """Sample a field, on its device, in cells of `voxel` (m), one to spare on each side.

        The interpolation's error falls with the voxel's square; the memory (76 bytes a vertex) and
        the time grow with its inverse's cube. Raises ConfigError where it is no positive number,
        or the grid would exceed 1 GB.
        """
        super().__init__(source.bounds)
        self.label, self.is_distance = f"{source.label} baked", source.is_distance
        self.surface_level = float(source.surface_level)
        self.voxel, self.n_vertices = float(voxel), _checked_size(source, voxel)
        # The first vertex lies one cell below the bounds; they are listed with z fastest.
        origin = torch.tensor([x - voxel for x in self.bounds.minimum], device=source.device)
        numbers = torch.arange(math.prod(self.n_vertices), device=source.device)
        answers = [
            source(origin + voxel * torch.stack(torch.unravel_index(part, self.n_vertices), -1))
            for part in numbers.split(_POINTS_AT_ONCE)
        ]
        color, value = map(torch.cat, zip(*answers, strict=True))
        # Steps to a vertex's neighbours, and from a cell's first vertex to its corners, of which
        # x changes fastest.
        strides = torch.tensor([self.n_vertices[1] * self.n_vertices[2], self.n_vertices[2], 1])
        offsets = torch.cartesian_prod(*3 * [torch.arange(2)]).flip(-1) @ strides
        last_vertex = value.new_tensor(self.n_vertices)[:, None] - 1
        samples = torch.stack([value, color @ LUMA.to(color)], dim=-1)
        # Rows of last vertices, where no cell starts, hold rubbish and are never read.
        cells = samples.new_zeros(len(samples), 2, 8)
        for corner, offset in enumerate(offsets.tolist()):
            cells[: len(samples) - offset, :, corner] = samples[offset:]
        self.register_buffer("color", color.T.contiguous())
        self.register_buffer("cells", cells)
        self.register_buffer("corner_offsets", offsets[:, None].to(source.device))
        self.register_buffer("strides", strides[:, None].to(value))
        self.register_buffer("origin_world", origin[:, None])
        self.register_buffer("first_vertex", torch.zeros_like(last_vertex))
        self.register_buffer("last_vertex", last_vertex)

    @property
    def n_bytes(self) -> int:
        """Memory of all buffers (bytes): 76 a vertex in single precision."""
        return sum(buffer.nbytes for buffer in self.buffers())

    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Colour in [0, 1] and value (m for a signed distance) at points (m).

        Differentiable with respect to the points, with the gradients of `linearize`.
        """
        _, index, fraction = self._locate(points_world)
        value = self.cells[:, 0].index_select(0, index).T
        color = self.color.index_select(1, (self.corner_offsets + index).flatten())
        corners = torch.cat([color.view(3, 8, -1), value[None]]).view(4, 2, 2, 2, -1)
        for along in fraction:
            low, high = corners.unbind(dim=-2)
            corners = torch.addcmul(low, along, high - low)
        return corners[:3].T, corners[3]

    @torch.no_grad()
    def linearize(self, points_world: Points) -> Linearization:
        """Value and intensity with the exact gradients of their interpolants."""
        is_inside, index, fraction = self._locate(points_world)
        rows = self.cells.index_select(0, index).flatten(1).T.contiguous()
        # Channel, derivative (first none; x, y and z join one by one), corners z, y, x, point.
        terms = rows.view(2, 1, 2, 2, 2, -1)
        for along in fraction:
            low, high = terms.unbind(dim=-2)
            slope = high - low
            terms = torch.cat([torch.addcmul(low, along, slope), slope[:, :1]], dim=1)
        value, intensity = terms[:, 0]
        of_value, of_intensity = terms[:, 1:] * (is_inside / self.voxel)
        return Linearization(value, of_value.T, intensity, of_intensity.T)

    def _locate(
        self, points_world: Points
    ) -> tuple[Bool[Tensor, "3 n"], Indices, Float[Tensor, "3 n"]]:
        """Whether inside, per axis; row of the cell; position between its borders in [0, 1]."""
        scaled = (points_world.T.contiguous() - self.origin_world) * (1 / self.voxel)
        inside = scaled.clamp(self.first_vertex, self.last_vertex)
        # The upper border belongs to the last cell. A point that is not a number finds some
        # cell, but its answers are not numbers either, as a network's would be.
        cell = torch.minimum(inside.detach().floor().nan_to_num(0.0), self.last_vertex - 1)
        index = (cell * self.strides).sum(dim=0, dtype=torch.int64)
        return inside == scaled, index, inside - cell


def _checked_size(field: Field, voxel: float | int) -> tuple[int, int, int]:
    """Vertices along x, y and z, if the grid is allowed. Raises ConfigError otherwise."""
    if not 0 < voxel < math.inf:
        raise ConfigError(
            f"voxel is {voxel} m: a baked field needs a positive length; set for instance 0.04"
        )
    extent = np.array(field.bounds.maximum) - np.array(field.bounds.minimum)
    # Stays floating-point until it is known to be small: 1e-300 m is a positive length.
    with np.errstate(over="ignore"):
        n_vertices = np.ceil(extent / voxel) + 3
        n_bytes = float(np.prod(n_vertices)) * _BYTES_PER_VERTEX
    if n_bytes > _MAX_BYTES:
        # The smallest that fits, with 5 % for the cells to spare and for rounding.
        enough = 1.05 * (float(np.prod(extent)) * _BYTES_PER_VERTEX / _MAX_BYTES) ** (1 / 3)
        raise ConfigError(
            f"voxel is {voxel} m: the baked grid would need {n_bytes / 1e9:.3g} GB, allowed is "
            f"{_MAX_BYTES / 1e9:g} GB; set {enough:.2g} m or more, or choose smaller bounds"
        )
    return tuple(n_vertices.astype(int).tolist())
