"""ICP: each frame is aligned with a fused point cloud, without any network."""

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from nbtrack.beyond.lm_solver import PRIOR_WEIGHT
from nbtrack.beyond.observed import draw_points
from nbtrack.beyond.points import PointCloud
from nbtrack.beyond.verdict import CORRELATED, MAD_FACTOR, p_within, std_when_moved
from nbtrack.core.arrays import Pose, Transforms
from nbtrack.data.frame import Frame
from nbtrack.machinery.errors import ConfigError
from nbtrack.tracking.tracker import Tracker, TrackerSettings

# How far from the map a point may be to have a partner there, m: first wide, to get home from
# where the motion model errs, then so narrow that what was not mapped pulls no more.
_WIDE = 0.3
_NARROW = 0.1
_FAR_APART = 0.06  # m, rad; starts that differ by less are taken for one, as by LM
_NEIGHBOURS = 20  # points that tell a point's plane
_MIN_POINTS = 20  # with fewer a frame keeps its start
_SEARCH = {"registration_type": "GICP", "num_threads": 1, "max_iterations": 30}
_SEARCH |= {"rotation_epsilon": 1e-3, "translation_epsilon": 1e-3}  # rad, m; smaller moves end it


@dataclass(frozen=True)
class IcpSettings(TrackerSettings):
    """Settings of ICP."""

    n_pixels: int = 512  # points a frame; evenly spread, as LM's are
    motion_model: str = "better_of_both"


class IcpTracker(Tracker):
    """Generalised ICP, plane to plane. One step is the whole alignment.

    Of the motion model's starts that are far apart, the one that finds partners for more points
    counts; else the first.

    Source: Segal, Haehnel, Thrun, "Generalized-ICP", RSS 2009, as in the package small_gicp (Koide
    2024). Distances, neighbours and voxels: our choice, tried on synthetic and real rooms.
    """

    name = "icp"
    package = "small_gicp"
    Settings = IcpSettings
    converges = True
    copes_without_depth = True

    def prepare(self, field: PointCloud) -> PointCloud:
        """The map on the host; planes of its points and a search tree are kept.

        Raises ConfigError where it has too few points for a plane.
        """
        if len(field.points) < _NEIGHBOURS:
            found = f"the map has {len(field.points)} points of {field.voxel:g} m cells"
            advice = "set a smaller mapping.points.voxel, or map more frames"
            raise ConfigError(f"{found}; ICP needs {_NEIGHBOURS} or more: {advice}")
        self.small_gicp = importlib.import_module(self.package)
        field = field.cpu()
        self.target = self.small_gicp.PointCloud(field.points.double().numpy())
        self.target_tree = self._find_planes(self.target)
        self.map_normals = self.target.normals()[:, :3]
        return field

    @classmethod
    def works_in(cls, field: type) -> bool:
        """Only in measured points."""
        return issubclass(field, PointCloud)

    def begin(self, frame: Frame, T_starts: Transforms) -> None:
        """Draw the frame's points and find their planes."""
        self.T_starts = T_starts.double().numpy()
        self.T_world_camera = T_starts[0]
        self.source = None
        self.is_converged = False
        self.found = None  # small_gicp's result of the alignment, for `report`
        # Points at depth edges are taken too (docs/tried.md).
        observed = draw_points(frame, self.settings.n_pixels, self.generator, edge_jump=np.inf)
        if len(observed.points):
            # Points that are closer than 1 cm count once.
            self.source = self.small_gicp.voxelgrid_sampling(observed.points, 0.01)
            self._find_planes(self.source)

    def step(self) -> float:
        """Align the frame; returns half the mean squared Mahalanobis distance of the inliers.

        Where too little was measured, or no point has a partner, the start remains.
        """
        self.is_converged = True
        if self.source is None or self.source.size() < _MIN_POINTS:
            return float("nan")
        # Far from the map the tree would look for partners for seconds, and find none.
        starts = [T for T in self.T_starts if self._is_near(T)]
        if not starts:
            return float("nan")
        if np.abs(self.T_starts - self.T_starts[0]).max() < _FAR_APART:
            starts = starts[:1]
        # Partners from far away first: of the starts the one that finds partners for more points.
        coarse = max([self._align(T, _WIDE) for T in starts], key=lambda result: result.num_inliers)
        found = self._align(coarse.T_target_source, _NARROW) if coarse.num_inliers else coarse
        if not found.num_inliers or not np.isfinite(found.T_target_source).all():
            return float("nan")
        self.T_world_camera = torch.from_numpy(found.T_target_source)
        self.found = found
        return found.error / found.num_inliers

    def _is_near(self, T_world_camera: Pose) -> bool:
        """Whether any point of the frame lies within `_WIDE` of the map's box at a pose."""
        points_world = (self.source.points() @ T_world_camera.T)[:, :3]
        low, high = self.field.tree.mins - _WIDE, self.field.tree.maxes + _WIDE
        return bool(((points_world > low) & (points_world < high)).all(axis=1).any())

    def _align(self, T_start: Pose, max_distance: float) -> Any:
        """small_gicp's result of the frame aligned with the map, with partners so near (m)."""
        options = {**_SEARCH, "max_correspondence_distance": max_distance}
        return self.small_gicp.align(self.target, self.source, self.target_tree, T_start, **options)

    def _distances(self, T_world_camera: Pose) -> Float[np.ndarray, "n"]:
        """How far (m) the points lie from their partners' planes; infinite where none is near."""
        points_world = (self.source.points() @ T_world_camera.T)[:, :3]
        tree = self.field.tree
        to_partners, partners = tree.query(points_world, distance_upper_bound=_NARROW)
        is_near = np.isfinite(to_partners)
        offsets = points_world[is_near] - tree.data[partners[is_near]]
        normals = self.map_normals[partners[is_near]]
        distances = np.full(len(points_world), np.inf)
        distances[is_near] = np.abs((offsets * normals).sum(axis=1))
        return distances

    def report(self) -> dict[str, float | bool]:
        """The share of points near the map, the position's std, and whether the frame is lost.

        It is lost if most points lie elsewhere, or if they fit as well at a wrong position. The
        verdict is no part of ICP, and no part of a frame's measured time.
        """
        if self.found is None:
            return {"inlier_ratio": 0.0, "lost": True}
        T_found = self.found.T_target_source
        distances = self._distances(T_found)
        # m; at least as far as the points of a voxel scatter.
        scale = max(MAD_FACTOR * np.median(distances[np.isfinite(distances)]), 0.005)

        # Geman-McClure's, in a form that is 1 at an infinite distance, not NaN.
        def costs_at(T_world_camera: Pose) -> Float[np.ndarray, "n"]:
            return 1 - 1 / (1 + (self._distances(T_world_camera) / scale) ** 2)

        # small_gicp's twists are in the camera's frame: both turn and offset are to be rotated.
        R_twist = np.kron(np.eye(2), T_found[:3, :3])
        H_world = R_twist @ self.found.H @ R_twist.T
        covariance = np.linalg.inv(H_world + PRIOR_WEIGHT * np.eye(6))
        # Only planes count here, so that a flat wall leaves two directions free: both are tried.
        # With 256 independent points half of the wrong poses before such a wall would pass as good.
        position_std_m = std_when_moved(costs_at, T_found, covariance, 2, n_independent=128)
        inlier_ratio = self.found.num_inliers / self.source.size()
        is_held = p_within(CORRELATED * position_std_m) > 0.5
        lost = inlier_ratio < 0.5 or not is_held
        return {"inlier_ratio": inlier_ratio, "position_std_m": position_std_m, "lost": lost}

    def _find_planes(self, cloud: Any) -> Any:
        """Give a cloud of small_gicp its normals and covariances; returns its search tree."""
        tree = self.small_gicp.KdTree(cloud)
        self.small_gicp.estimate_normals_covariances(cloud, tree, _NEIGHBOURS)
        return tree
