"""A field that is sampled once on a regular grid, and then interpolated trilinearly.

A query of a network costs 250,000 products a point, and one of the grid reads eight vertices. The
interpolant is continuous. Its gradient is exact, and jumps from cell to cell.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor
from torch.nn.functional import grid_sample

from nbtrack.beyond.views import Viewpoints
from nbtrack.core.arrays import Colors, Points, Values
from nbtrack.core.bounds import SceneBounds
from nbtrack.fields.base import Field
from nbtrack.machinery.device import constant, usual_modes
from nbtrack.machinery.errors import ConfigError
from nbtrack.machinery.inputs import check_array

_POINTS_AT_ONCE = 65_536  # batch size when a field is sampled
_MAX_BYTES = 500_000_000  # of a grid: 25 million vertices, sampled in some minutes (our choice)
_BYTES_PER_VERTEX = 4 * (3 + 1 + 1)  # colour, value and confidence


class Accuracy(NamedTuple):
    """How large residuals at surfaces usually are, by errors of a map and of depth cameras.

    The defaults are for small networks whose residuals were not measured (our choice).
    """

    # LM's smallest robust scales of distance (m) and luma: larger residuals are down-weighted.
    residual_sigma: tuple[float, float] = (0.02, 0.05)
    inlier_distance: float = 0.05  # m; a point nearer to the surface is an inlier
    intensity_mad: float = 0.02  # the median absolute residual of luma


class BakedField(Field):
    """A frozen copy of another field on a regular grid over its bounds. Our choice.

    Points outside are moved to the grid's border, so that the gradient across the border is 0.
    """

    name = "baked"
    width = 0  # one thread serves a grid, even one that keeps the network it was made from
    accuracy = Accuracy()
    viewpoints: Viewpoints | None = None  # for relocalisation; None: not known

    @usual_modes()
    @torch.no_grad()
    def __init__(self, source: Field, voxel: float | int) -> None:
        """Sample a field, on its device, at the vertices of cells of `voxel` (m).

        The grid extends at least one cell beyond the bounds at each side. With half the voxel the
        error of interpolation is a quarter, and the memory (20 bytes a vertex) and the time are
        eight times as much. Raises ConfigError as `checked_size` does.
        """
        super().__init__(source.bounds)
        self.label = f"{source.label} baked"
        self.is_distance = source.is_distance
        self.surface_level = float(source.surface_level)
        self.voxel = float(voxel)
        self.n_vertices = checked_size(source.bounds, voxel)
        # The first vertex lies one cell below the bounds. Vertices are in row-major order: z is
        # fastest.
        first = [x - voxel for x in self.bounds.minimum]
        low = torch.tensor(first, dtype=torch.float32).to(source.device)
        axes = [torch.arange(n, dtype=torch.int32, device=low.device) for n in self.n_vertices]
        batches = torch.cartesian_prod(*axes).split(_POINTS_AT_ONCE)
        answers = [source(low + voxel * vertices.float()) for vertices in batches]
        color, value = (torch.cat(parts) for parts in zip(*answers, strict=True))
        # Channels: red, green, blue, value, and a confidence of 1 everywhere.
        volume = torch.cat([color.T, value[None], torch.ones_like(value)[None]])
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("volume", volume, persistent=False)

    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Colour in [0, 1] and value at points (m, world frame), differentiable.

        The value means what it means in the sampled field, such as a signed distance (m).
        """
        values = self.channels(points_world)
        return values[:3].T, values[3]

    def channels(self, points_world: Points) -> Float[Tensor, "5 points"]:
        """Red, green, blue, value and confidence at points (m, world frame); NaN at NaN.

        The confidence says how well the surface is known, in [0, 1]. Points may have any precision.
        Raises DataError for anything but a tensor of shape (n, 3).
        """
        check_array("points", points_world, ("n", 3), [Shaped], "in m", Tensor)
        volume = self.volume.view(5, *self.n_vertices)
        values = trilinear(volume, self.low, self.voxel, points_world.float())
        # At a position that is NaN, `trilinear` returns values of the border.
        return torch.where(points_world.isnan().any(dim=1), torch.nan, values)


def trilinear(
    volume: Float[Tensor, "channels x y z"], low: Float[Tensor, "3"], voxel: float, points: Points
) -> Float[Tensor, "channels n"]:
    """Interpolate a volume at points (m), differentiably.

    The volume's first vertex is at `low` (m), and neighbouring vertices are `voxel` (m) apart.
    Points outside are moved to the border.
    """
    extent = voxel * (constant(tuple(volume.shape[1:]), low.device, low.dtype) - 1)
    # `grid_sample` takes positions from -1 to 1, in the reverse order of the volume's axes.
    normalized = (2 * (points - low) / extent - 1).flip(1)[None, None, None]
    values = grid_sample(volume[None], normalized, padding_mode="border", align_corners=True)
    return values[0, :, 0, 0]


def checked_size(bounds: SceneBounds, voxel: float | int, key: str = "voxel") -> tuple[int, ...]:
    """The numbers of vertices along x, y and z of a grid with cells of `voxel` (m).

    Raises ConfigError unless the voxel is positive and the grid fits in 0.5 GB. The message calls
    the setting by its `key`.
    """
    extent = np.subtract(bounds.maximum, bounds.minimum)
    # A tiny positive voxel, such as 1e-300 m, makes infinitely many vertices, without a warning.
    with np.errstate(all="ignore"):
        n_vertices = np.ceil(extent / voxel) + 3  # one cell more at each side, and the last vertex
        n_bytes = float(np.prod(n_vertices)) * _BYTES_PER_VERTEX
    if not (0 < voxel < math.inf and n_bytes <= _MAX_BYTES):
        # The smallest voxel that fits, enlarged by 5 % for the cells at the sides and for rounding.
        enough = 1.05 * (float(np.prod(extent)) * _BYTES_PER_VERTEX / _MAX_BYTES) ** (1 / 3)
        raise ConfigError(
            f"{key} is {voxel} m, of a scene of {' x '.join(f'{x:.3g}' for x in extent)} m: a "
            f"grid may take {_MAX_BYTES / 1e9:g} GB; set {key}={enough:.2g} or more; "
            "is the scene smaller than that, `data check` may tell which depths or poses are wrong"
        )
    return tuple(n_vertices.astype(int).tolist())
