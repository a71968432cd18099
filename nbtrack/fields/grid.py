"""A field baked into a dense grid: sampled once, then answered by trilinear interpolation.

A network costs 250,000 products a point; a tracker asks the same map for every frame. The grid
answers with one row of memory a point. The interpolant is continuous, and the gradient is its
exact derivative, which jumps from cell to cell.

Computations keep the points on the last axis: torch is slow where the last axis is short.
"""

import itertools
import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nbtrack.core.errors import ConfigError
from nbtrack.fields.base import LUMA, Field, Linearization

_POINTS_AT_ONCE = 65_536
_MAX_BYTES = 1_000_000_000
# A vertex holds its colour (3 floats) and, for the cell that starts there, value and intensity
# of all 8 corners: 8 times the memory of the samples, but one cache line a query, not 4 to 8.
_BYTES_PER_VERTEX = 4 * (3 + 2 * 8)
# Corners of a cell in the order in which rows list them: x + 2 y + 4 z.
_CORNERS = tuple((x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1))


class BakedField(Field):
    """A frozen copy of another field on a regular grid. Source: our choice; see the module.

    Made by `bake_field`. Points outside the grid are moved to its border, so nothing changes
    along an axis on which a point is outside: the gradient is 0 there.
    """

    name = "baked"

    def __init__(
        self,
        source: Field,
        voxel: float | int,
        n_vertices: tuple[int, int, int],
        color: Float[Tensor, "vertices 3"],
        value: Float[Tensor, "vertices"],
    ) -> None:
        """Keep samples at the vertices of a grid that starts one cell outside the bounds.

        Args:
            source: what was sampled; gives bounds, label and surface level, and is not kept.
            voxel: edge of a cell (m).
            n_vertices: along x, y and z; the samples list z fastest.
            color: in [0, 1].
            value: of the field, m for a signed distance.
        """
        super().__init__(source.bounds)
        self.label = f"{source.label} baked"
        self.voxel = float(voxel)
        self.n_vertices = n_vertices
        self._surface_level = float(source.surface_level)
        samples = torch.stack([value, color @ LUMA.to(color)], dim=-1)
        last_vertex = value.new_tensor(n_vertices)[:, None] - 1
        self.register_buffer("color", color.T.contiguous())
        self.register_buffer("cells", _cell_rows(samples, n_vertices))
        offsets = [[_offset(corner, n_vertices)] for corner in _CORNERS]
        self.register_buffer("corner_offsets", torch.tensor(offsets, device=value.device))
        self.register_buffer("strides", value.new_tensor(_strides(n_vertices))[:, None])
        self.register_buffer("origin_world", value.new_tensor(_origin(source, voxel))[:, None])
        self.register_buffer("first_vertex", torch.zeros_like(last_vertex))
        self.register_buffer("last_vertex", last_vertex)
        self.register_buffer("last_cell", last_vertex - 1)

    @property
    def n_bytes(self) -> int:
        """Memory of all buffers (bytes): 76 a vertex in single precision."""
        return sum(buffer.numel() * buffer.element_size() for buffer in self.buffers())

    @property
    def surface_level(self) -> float:
        """That of the field that was baked."""
        return self._surface_level

    def forward(
        self, points_world: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
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
    def linearize(self, points_world: Float[Tensor, "n 3"]) -> Linearization:
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
        self, points_world: Float[Tensor, "n 3"]
    ) -> tuple[Bool[Tensor, "3 n"], Int[Tensor, "n"], Float[Tensor, "3 n"]]:
        """Whether inside, per axis; row of the cell; position between its borders in [0, 1]."""
        scaled = (points_world.T.contiguous() - self.origin_world) * (1 / self.voxel)
        inside = scaled.clamp(self.first_vertex, self.last_vertex)
        # The upper border belongs to the last cell. A point that is not a number finds some
        # cell, but its answers are not numbers either, as a network's would be.
        cell = torch.minimum(inside.detach().floor().nan_to_num(0.0), self.last_cell)
        index = (cell * self.strides).sum(dim=0, dtype=torch.int64)
        return inside == scaled, index, inside - cell


@torch.no_grad()
def bake_field(field: Field, voxel: float | int) -> BakedField:
    """Sample colour and value of a field once on a grid over its bounds, one cell to spare.

    Args:
        field: any field; it is asked on its own device, where the result stays.
        voxel: edge of a cell (m). The interpolation's error falls with its square, the memory
            (76 bytes a vertex) and the time to bake grow with its inverse's cube.

    Raises:
        ConfigError: the voxel is no positive number, or the grid would exceed 1 GB.
    """
    n_vertices = _checked_size(field, voxel)
    tensors = itertools.chain(field.parameters(), field.buffers())
    device = next((tensor.device for tensor in tensors), torch.device("cpu"))
    origin = torch.tensor(_origin(field, voxel), device=device)
    total = math.prod(n_vertices)
    color, value = torch.empty(total, 3, device=device), torch.empty(total, device=device)
    for start in range(0, total, _POINTS_AT_ONCE):
        stop = min(start + _POINTS_AT_ONCE, total)
        numbers = torch.arange(start, stop, device=device)
        vertices = torch.stack(torch.unravel_index(numbers, n_vertices), dim=-1)
        color[start:stop], value[start:stop] = field(origin + voxel * vertices)
    return BakedField(field, voxel, n_vertices, color, value)


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
    x, y, z = n_vertices.astype(int).tolist()
    return x, y, z


def _origin(field: Field, voxel: float | int) -> list[float]:
    """World position (m) of the first vertex: one cell below the bounds."""
    return [low - voxel for low in field.bounds.minimum]


def _strides(n_vertices: tuple[int, int, int]) -> tuple[int, int, int]:
    """Steps from a vertex to its neighbours along x, y and z in a flat list with z fastest."""
    return n_vertices[1] * n_vertices[2], n_vertices[2], 1


def _offset(corner: tuple[int, int, int], n_vertices: tuple[int, int, int]) -> int:
    """Steps in that list from a cell's first vertex to one of its corners."""
    return sum(c * stride for c, stride in zip(corner, _strides(n_vertices), strict=True))


def _cell_rows(
    samples: Float[Tensor, "vertices 2"], n_vertices: tuple[int, int, int]
) -> Float[Tensor, "vertices 2 8"]:
    """Both channels at the corners of the cell that starts at each vertex.

    No cell starts at a last vertex of an axis: such rows hold rubbish and are never read. They
    let cells and vertices share one index.
    """
    rows = samples.new_zeros(len(samples), 2, 8)
    for number, corner in enumerate(_CORNERS):
        offset = _offset(corner, n_vertices)
        rows[: len(samples) - offset, :, number] = samples[offset:]
    return rows
