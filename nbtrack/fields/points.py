"""Points: a fused point cloud as a field. No network; classical registration aligns with it."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor, nn

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.config import FieldConfig
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields.base import Field, register_field
from nbtrack.fields.fusion import fuse_points


@register_field
class PointField(Field):
    """The measured points themselves, one a voxel: what a map costs that learns nothing.

    A fresh field is empty: `fuse` or a stored state fills it.
    """

    name = "points"
    label = "Points"

    points: Float[Tensor, "n 3"]  # m, world frame
    colors: Float[Tensor, "n 3"]  # in [0, 1]

    def __init__(
        self, config: FieldConfig, bounds: SceneBounds, generator: torch.Generator
    ) -> None:
        """Nothing of the network's settings is used, nor anything random."""
        super().__init__(bounds)
        self.register_buffer("points", torch.empty(0, 3))
        self.register_buffer("colors", torch.empty(0, 3))
        # Edge of the voxels, m. A parameter that nobody fits, so that whoever asks a field's
        # parameters for its device gets an answer.
        self.voxel = nn.Parameter(torch.zeros(1), requires_grad=False)
        self._tree: cKDTree | None = None

    def fuse(self, sequence: RgbdSequence, frames: Int[np.ndarray, "frames"], voxel: float) -> None:
        """Replace the points by those of some frames, one a voxel of an edge in metres."""
        points, colors = fuse_points(sequence, frames, self.bounds, voxel)
        self.points = torch.from_numpy(points).to(self.voxel.device)
        self.colors = torch.from_numpy(colors).to(self.voxel.device)
        self.voxel.fill_(voxel)
        self._tree = None

    def forward(
        self, points_world: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Colour of the nearest point, and the distance to it (m), which has no sign."""
        if self._tree is None:
            self._tree = cKDTree(self.points.cpu().numpy())
        distance, nearest = self._tree.query(points_world.detach().cpu().numpy())
        nearest = torch.from_numpy(nearest).to(self.colors.device)
        return self.colors[nearest], torch.from_numpy(distance).float().to(points_world)

    @property
    def surface_level(self) -> float:
        """Half a voxel: a thin shell around the points."""
        return self.voxel.item() / 2

    @property
    def n_bytes(self) -> int:
        """Memory of positions and colours; a search tree over them comes on top."""
        return self.points.nbytes + self.colors.nbytes

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *arguments: Any
    ) -> None:
        """Take the stored points, however many they are."""
        for name in ("points", "colors"):
            if prefix + name in state_dict:
                stored = state_dict[prefix + name]
                setattr(self, name, torch.empty_like(stored, device=self.voxel.device))
        self._tree = None
        super()._load_from_state_dict(state_dict, prefix, *arguments)
