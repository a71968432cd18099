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
from nbtrack.machinery.settings import one_of
from nbtrack.tracking.tracker import Tracker, TrackerSettings

# A point's correspondence is the nearest map point within this distance (m). A first alignment has
# the wide limit, since the motion model's start may be off. A second one has the narrow limit, so
# that points of what was not mapped have no correspondence, and no influence.
_WIDE = 0.3
_NARROW = 0.1
_FAR_APART = 0.06  # m, rad; starts that differ by less count as one, as in `LmTracker`
_NEIGHBOURS = 20  # nearest points that a point's plane is fitted to
_MIN_POINTS = 20  # a frame with fewer points keeps its start
_SEARCH = {"registration_type": "GICP", "num_threads": 1, "max_iterations": 30}
_SEARCH |= {"rotation_epsilon": 1e-3, "translation_epsilon": 1e-3}  # rad, m; smaller steps end it


@dataclass(frozen=True)
class IcpSettings(TrackerSettings):
    """Settings of ICP."""

    n_pixels: int = 512  # points a frame, of evenly spread pixels
    motion_model: str = one_of("better_of_both", "previous_pose", "constant_velocity")


class IcpTracker(Tracker):
    """Generalised ICP, plane to plane. One step is the whole alignment of a frame.

    The motion model may give several starts. If they are far apart, each is aligned, and the one
    with the most inliers (points that have a correspondence) is kept. Otherwise the first is used.

    Source: Segal, Haehnel, Thrun, "Generalized-ICP", RSS 2009, as in the package small_gicp (Koide
    2024). Distances, neighbours and voxels: our choice, tried on synthetic and real rooms.
    """

    name = "icp"
    package = "small_gicp"
    Settings = IcpSettings
    converges = True
    copes_without_depth = True

    def prepare(self, field: PointCloud) -> PointCloud:
        """Prepare the map for alignments, and return it on the host.

        Its points get normals, covariances and a search tree. Raises ConfigError if there are fewer
        points than a plane is fitted to.
        """
        if len(field.points) < _NEIGHBOURS:
            found = f"the map has {len(field.points)} points of {field.voxel:g} m cells"
            advice = "set a smaller mapping.points.voxel, or map more frames"
            raise ConfigError(f"{found}; ICP needs {_NEIGHBOURS} or more: {advice}")
        self.small_gicp = importlib.import_module(self.package)
        field = field.cpu()
        self.target = self.small_gicp.PointCloud(field.points.double().numpy())
        self.target_tree = self.small_gicp.KdTree(self.target)
        self.small_gicp.estimate_normals_covariances(self.target, self.target_tree, _NEIGHBOURS)
        self.map_normals = self.target.normals()[:, :3]
        return field

    @classmethod
    def works_in(cls, field: type) -> bool:
        """Whether a field is a map of measured points, which ICP needs."""
        return issubclass(field, PointCloud)

    def begin(self, frame: Frame, T_starts: Transforms) -> None:
        """Draw the frame's points and fit their planes."""
        self.T_starts = T_starts.double().numpy()
        self.T_world_camera = T_starts[0]
        self.source = None
        self.is_converged = False
        self.found = None  # small_gicp's result of the alignment, for `report`
        # Unlike LM, ICP takes points at depth edges, too (docs/tried.md).
        observed = draw_points(frame, self.settings.n_pixels, self.generator, edge_jump=np.inf)
        if len(observed.points):
            # The points of each cell of 1 cm are averaged.
            self.source = self.small_gicp.voxelgrid_sampling(observed.points, 0.01)
            self.small_gicp.estimate_normals_covariances(self.source, num_neighbors=_NEIGHBOURS)

    def step(self) -> float:
        """Align the frame; returns half the mean squared Mahalanobis distance of the inliers.

        The pose remains the first start, and NaN is returned, if too few points were measured or
        none has a correspondence.
        """
        self.is_converged = True
        if self.source is None or self.source.size() < _MIN_POINTS:
            return float("nan")
        # For points far from the map the tree would search for seconds, and find nothing.
        starts = [T for T in self.T_starts if self._is_near(T)]
        if not starts:
            return float("nan")
        if np.abs(self.T_starts - self.T_starts[0]).max() < _FAR_APART:
            starts = starts[:1]
        # The start with the most inliers in the wide alignment is aligned again, narrowly.
        results = [self._align(T, _WIDE) for T in starts]
        found = max(results, key=lambda result: result.num_inliers)
        if found.num_inliers:
            found = self._align(found.T_target_source, _NARROW)
        if not found.num_inliers or not np.isfinite(found.T_target_source).all():
            return float("nan")
        self.T_world_camera = torch.from_numpy(found.T_target_source)
        self.found = found
        return found.error / found.num_inliers

    def _is_near(self, T_world_camera: Pose) -> bool:
        """Whether any point of the frame, at a pose, lies within `_WIDE` of the map's box."""
        points_world = (self.source.points() @ T_world_camera.T)[:, :3]
        low, high = self.field.tree.mins - _WIDE, self.field.tree.maxes + _WIDE
        return bool(((points_world > low) & (points_world < high)).all(axis=1).any())

    def _align(self, T_start: Pose, max_distance: float) -> Any:
        """small_gicp's result of aligning the frame with the map, from a start.

        Correspondences are at most `max_distance` (m) apart.
        """
        options = {**_SEARCH, "max_correspondence_distance": max_distance}
        return self.small_gicp.align(self.target, self.source, self.target_tree, T_start, **options)

    def _distances(self, T_world_camera: Pose) -> Float[np.ndarray, "n"]:
        """Distances (m) of the frame's points, at a pose, from planes of the map.

        A point's plane is that of the nearest map point. Its distance is infinite if no map point
        lies within `_NARROW`.
        """
        points_world = (self.source.points() @ T_world_camera.T)[:, :3]
        tree = self.field.tree
        to_nearest, nearest = tree.query(points_world, distance_upper_bound=_NARROW)
        is_near = np.isfinite(to_nearest)
        offsets = points_world[is_near] - tree.data[nearest[is_near]]
        normals = self.map_normals[nearest[is_near]]
        distances = np.full(len(points_world), np.inf)
        distances[is_near] = np.abs((offsets * normals).sum(axis=1))
        return distances

    def report(self) -> dict[str, float | bool]:
        """The share of inliers, the position's standard deviation (m), and whether it is lost.

        A frame is lost if fewer than half of its points are inliers, or if it is likely that they
        fit as well at a wrong position. This verdict is no part of ICP, and its time is no part of
        a frame's.
        """
        if self.found is None:
            return {"inlier_ratio": 0.0, "lost": True}
        T_found = self.found.T_target_source
        distances = self._distances(T_found)
        # m. At least 5 mm: so far the mean points of voxels scatter about a surface.
        scale = max(MAD_FACTOR * np.median(distances[np.isfinite(distances)]), 0.005)

        # Geman and McClure's cost, in a form that is 1, and not NaN, at an infinite distance.
        def costs_at(T_world_camera: Pose) -> Float[np.ndarray, "n"]:
            return 1 - 1 / (1 + (self._distances(T_world_camera) / scale) ** 2)

        # small_gicp's Hessian is for twists with the camera's axes. `std_when_moved` takes twists
        # with world axes, so that both halves, rotation and translation, are rotated.
        R_twist = np.kron(np.eye(2), T_found[:3, :3])
        H_world = R_twist @ self.found.H @ R_twist.T
        covariance = np.linalg.inv(H_world + PRIOR_WEIGHT * np.eye(6))
        # Distances from planes do not hold a camera along a flat wall, so that two directions are
        # tried. Taking 256 points for independent, a third to a half of the wrong poses before such
        # a wall were taken for right (docs/tried.md).
        position_std_m = std_when_moved(costs_at, T_found, covariance, 2, n_independent=128)
        inlier_ratio = self.found.num_inliers / self.source.size()
        is_held = p_within(CORRELATED * position_std_m) > 0.5
        lost = inlier_ratio < 0.5 or not is_held
        return {"inlier_ratio": inlier_ratio, "position_std_m": position_std_m, "lost": lost}
