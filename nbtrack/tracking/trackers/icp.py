"""ICP (points): each frame is aligned with a fused point cloud, without any network."""

import importlib
from types import ModuleType
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.core.camera import backproject
from nbtrack.core.config import TrackingConfig
from nbtrack.core.errors import MissingError
from nbtrack.data.pixels import PixelSampler
from nbtrack.fields import Field
from nbtrack.tracking.trackers.base import Tracker, register_tracker

# How far from the map a point may be to have a partner there, m: first wide, to get home from
# where the motion model errs, then so narrow that what was not mapped pulls no more.
_REACHES = (0.3, 0.1)
_SOURCE_VOXEL = 0.01  # m: pixels drawn twice, and close ones, count once
_NEIGHBOURS = 20  # points that tell a point's plane
_LEAST_POINTS = 20
_LEAST_INLIERS = 0.5
_MOST_ITERATIONS = 30
_LEAST_ROTATION, _LEAST_TRANSLATION = 1e-3, 1e-3  # rad and m: a smaller move ends the search


@register_tracker
class IcpTracker(Tracker):
    """Generalised ICP, plane to plane, from the first start. One step is the whole alignment.

    Source: Segal, Haehnel, Thrun, "Generalized-ICP", RSS 2009, as the package small_gicp (Koide
    2024) implements it. Reaches, neighbours and voxels are our choice, tried on a synthetic
    room and on a real one.
    """

    name = "icp"
    label = "ICP (points)"
    short_label = "ICP"
    field_name = "points"
    paper_steps = "sdf"
    table_order = 6
    in_paper_tables = False
    copes_without_depth = True

    def __init__(
        self,
        field: Field,
        sampler: PixelSampler,
        config: TrackingConfig,
        generator: torch.Generator,
    ) -> None:
        """Prepare the map: every point's plane from its neighbours, and a search tree.

        Raises:
            MissingError: small_gicp is not installed.
        """
        super().__init__(field, sampler, config, generator)
        self.small_gicp = _small_gicp()
        self.target, self.target_tree = self._with_planes(field.points.cpu().double().numpy())

    def start_frame(self, frame: int, T_starts: Float[Tensor, "starts 4 4"]) -> None:
        """Draw the frame's points and find their planes; the first pose is the start."""
        self.T_estimated, self.is_aligned, self.inlier_ratio = T_starts[0], False, 0.0
        rows, columns = self.sampler.measured_pixels(frame)
        if not len(rows):
            self.source = self.small_gicp.PointCloud(np.empty((0, 3)))
            return
        drawn = torch.randint(
            len(rows), (self.config.n_pixels,),
            generator=self.generator, device=self.generator.device,
        )  # fmt: skip
        rows, columns = rows[drawn], columns[drawn]
        depth = self.sampler.measurements(torch.full_like(rows, frame), rows, columns)[1]
        points_camera = backproject(self.sampler.intrinsics, columns, rows, depth)
        thinned = self.small_gicp.voxelgrid_sampling(
            points_camera.cpu().double().numpy(), _SOURCE_VOXEL
        )
        self.source, _ = self._with_planes(thinned)

    def step(self) -> Float[Tensor, ""]:
        """Align the frame; returns half the mean squared Mahalanobis distance of the inliers.

        Where too little was measured, or no point has a partner, the start remains.
        """
        self.is_aligned = True
        if self.source.size() < _LEAST_POINTS:
            return torch.tensor(float("nan"))
        T_world_camera = self.T_estimated.cpu().double().numpy()
        for reach in _REACHES:
            result = self.small_gicp.align(
                self.target, self.source, self.target_tree, T_world_camera,
                registration_type="GICP", max_correspondence_distance=reach, num_threads=1,
                max_iterations=_MOST_ITERATIONS, rotation_epsilon=_LEAST_ROTATION,
                translation_epsilon=_LEAST_TRANSLATION,
            )  # fmt: skip
            if not result.num_inliers or not np.isfinite(result.T_target_source).all():
                return torch.tensor(float("nan"))
            T_world_camera = result.T_target_source
        self.T_estimated = torch.from_numpy(T_world_camera.copy()).to(self.T_estimated)
        self.inlier_ratio = result.num_inliers / self.source.size()
        return torch.tensor(result.error / result.num_inliers)

    @property
    def is_converged(self) -> bool:
        """After one step nothing is left to do."""
        return self.is_aligned

    def report(self) -> dict[str, float | bool]:
        """The share of the points that lie near the map; lost where most do not."""
        return {
            "inlier_ratio": self.inlier_ratio,
            "lost": self.inlier_ratio < _LEAST_INLIERS,
        }

    @property
    def T_world_camera(self) -> Float[Tensor, "4 4"]:
        """The present estimate."""
        return self.T_estimated

    def _with_planes(self, points: Any) -> tuple[Any, Any]:
        """A cloud of small_gicp with covariances, and its tree; from (n, 3) or a cloud."""
        cloud = points
        if isinstance(points, np.ndarray):
            cloud = self.small_gicp.PointCloud(points)
        tree = self.small_gicp.KdTree(cloud)
        self.small_gicp.estimate_covariances(cloud, tree, _NEIGHBOURS)
        return cloud, tree


def _small_gicp() -> ModuleType:
    try:
        return importlib.import_module("small_gicp")
    except ImportError:
        raise MissingError(
            "tracker icp needs the package small_gicp: pip install 'nbtrack[icp]'"
        ) from None
