"""Random pixels of a sequence as rays, and where along the rays to look."""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nbtrack.bounds import SceneBounds
from nbtrack.camera import backproject, pixel_directions
from nbtrack.config import MappingConfig
from nbtrack.data import MILLIMETRE, Sequence
from nbtrack.device import has_room_for
from nbtrack.fields.base import Batch, LearnedField, Rays
from nbtrack.rendering import Rendering, importance_depths, stratified_depths

NEAR = 0.05  # m, z-depth before which nothing is looked for: closer than any depth camera measures

# Tangent planes: how far away neighbours are, as a share of the image's width, and by how much of
# the depth they may differ, which cuts off edges and incidences above some 75 degrees (our choice).
_PLANE_REACH, _PLANE_JUMP = 1 / 64, 0.1
# Points to track: a neighbouring depth that differs by more, as a share, marks an edge.
_EDGE_JUMP = 0.05
_DRAWN_PER_POINT = 4


class PixelSampler:
    """Draws measured pixels of a sequence, for a network on some device.

    Images stay 8 and 16 bit; only drawn pixels become floating point, so that a long sequence of
    full-size frames fits a laptop's memory. The images lie on the device too if it has room to
    spare, else on the host, from where drawn pixels travel; what is drawn is the same.
    """

    def __init__(
        self, sequence: Sequence, device: torch.device, images_device: torch.device | None = None
    ) -> None:
        """
        Args:
            device: where the network is, and everything that is drawn.
            images_device: where the images lie; by default chosen by free memory.
        """
        n_bytes = sequence.colors.nbytes + sequence.depths_mm.nbytes
        if images_device is None:
            images_device = device if has_room_for(device, n_bytes) else torch.device("cpu")
        self.device, self.images_device = device, images_device
        self.intrinsics = sequence.intrinsics
        self.colors = torch.from_numpy(sequence.colors).to(images_device)
        # Few torch kernels know unsigned 16 bit: the same bits travel as signed.
        self.depths_mm = torch.from_numpy(sequence.depths_mm.view("int16")).to(images_device)
        self.T_world_camera = torch.from_numpy(sequence.T_world_camera).float().to(device)

    def show(self, sequence: Sequence) -> None:
        """Take other images of the same size and number, into the same memory.

        Steps that were captured as a CUDA graph go on reading there.
        """
        self.colors.copy_(torch.from_numpy(sequence.colors))
        self.depths_mm.copy_(torch.from_numpy(sequence.depths_mm.view("int16")))
        self.T_world_camera.copy_(torch.from_numpy(sequence.T_world_camera))

    def rays(
        self,
        frames: Int[Tensor, "n"],
        rows: Int[Tensor, "n"],
        columns: Int[Tensor, "n"],
    ) -> Rays:
        """Rays through given pixels, with their measurements."""
        color, depth = self.measurements(frames, rows, columns)
        T_world_camera = self.T_world_camera[frames]
        directions_camera = pixel_directions(self.intrinsics, columns, rows)
        directions = (T_world_camera[:, :3, :3] @ directions_camera[..., None]).squeeze(-1)
        return Rays(T_world_camera[:, :3, 3], directions, color, depth)

    def plane_distance_per_depth(
        self, frames: Int[Tensor, "n"], rows: Int[Tensor, "n"], columns: Int[Tensor, "n"]
    ) -> Float[Tensor, "n"]:
        """Distance from the tangent plane at a pixel for one metre of z-depth; see `Rays`.

        The plane goes through the pixel's neighbours to the left and right, above and below, some
        pixels away, so that noise tilts it little. 0 where one of them is not measured, or lies on
        another surface.
        """
        _, height, width = self.depths_mm.shape
        reach = max(1, round(width * _PLANE_REACH))
        depth = self.measurements(frames, rows, columns)[1]
        points, is_whole = [], depth > 0
        for down, right in ((0, -reach), (0, reach), (-reach, 0), (reach, 0)):
            row, column = rows + down, columns + right
            is_whole &= (row >= 0) & (row < height) & (column >= 0) & (column < width)
            row, column = row.clamp(0, height - 1), column.clamp(0, width - 1)
            near = self.measurements(frames, row, column)[1]
            is_whole &= (near > 0) & ((near - depth).abs() < _PLANE_JUMP * depth)
            points.append(backproject(self.intrinsics, column, row, near))
        normal = torch.linalg.cross(points[1] - points[0], points[3] - points[2])
        normal = torch.nn.functional.normalize(normal, dim=-1)
        directions = pixel_directions(self.intrinsics, columns, rows)
        return (normal * directions).sum(dim=-1).abs() * is_whole

    def measurements(
        self, frames: Int[Tensor, "n"], rows: Int[Tensor, "n"], columns: Int[Tensor, "n"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Colour in [0, 1] and z-depth (m, 0 = none) of pixels."""
        where = tuple(index.to(self.images_device) for index in (frames, rows, columns))
        color = self.colors[where].to(self.device).float() / 255
        depth_mm = self.depths_mm[where].to(self.device).int() & 0xFFFF
        return color, depth_mm.float() * MILLIMETRE

    def draw(
        self,
        n_rays: int,
        generator: torch.Generator,
        frames: Int[Tensor, "frames"],
        tangent_planes: bool = False,
    ) -> Rays:
        """Rays through pixels drawn uniformly over the given frames; with planes, if asked for."""
        _, height, width = self.depths_mm.shape
        chosen, rows, columns = (
            torch.randint(limit, (n_rays,), generator=generator, device=generator.device)
            for limit in (len(frames), height, width)
        )
        rays = self.rays(frames[chosen], rows, columns)
        if not tangent_planes:
            return rays
        per_depth = self.plane_distance_per_depth(frames[chosen], rows, columns)
        return replace(rays, plane_distance_per_depth=per_depth)

    def smooth_points(
        self, frame: int, n_points: int, generator: torch.Generator
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Observed points (m, camera frame) of a frame and their colours in [0, 1], at random.

        Pixels at the border and at depth edges are left out: an edge's depth may belong to either
        side. Only a few times as many pixels as wanted are looked at, whatever the image's size;
        where a frame is sparsely measured, fewer than `n_points` come back.
        """
        _, height, width = self.depths_mm.shape
        drawn = (_DRAWN_PER_POINT * n_points,)
        rows, columns = (
            torch.randint(1, size - 1, drawn, generator=generator, device=generator.device)
            for size in (height, width)
        )
        frames = torch.full_like(rows, frame)
        color, depth = self.measurements(frames, rows, columns)
        is_smooth = depth > 0
        for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            beside = self.measurements(frames, rows + down, columns + right)[1]
            is_smooth &= (beside - depth).abs() < _EDGE_JUMP * depth
        kept = torch.nonzero(is_smooth).squeeze(-1)[:n_points]
        points = backproject(self.intrinsics, columns[kept], rows[kept], depth[kept])
        return points, color[kept]

    def measured_pixels(self, frame: int) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
        """Rows and columns of all pixels of one frame that have a depth."""
        rows, columns = torch.nonzero(self.depths_mm[frame], as_tuple=True)
        return rows.to(self.device), columns.to(self.device)


def draw_batch(
    field: LearnedField,
    sampler: PixelSampler,
    config: MappingConfig,
    generator: torch.Generator,
    frames: Int[Tensor, "frames"],
) -> Batch:
    """Rays for one iteration of mapping, with samples by the field's own wish: guided or not."""
    rays = sampler.draw(config.n_rays, generator, frames, field.is_taught_distances)
    if field.depth_guided:
        depths = guided_depths(rays, field.bounds, config, generator)
    else:
        depths = two_pass_depths(field, rays, config.n_stratified, config.n_surface, generator)
    if not field.is_taught_distances:
        return Batch(rays, depths)
    return Batch(rays, depths, sampler.draw(config.n_surface_points, generator, frames))


def guided_depths(
    rays: Rays, bounds: SceneBounds, config: MappingConfig, generator: torch.Generator
) -> Float[Tensor, "rays samples"]:
    """Stratified z-depths (m) up to just behind the measured surface, and more around it.

    Nothing is known of what lies behind a surface, so no samples are spent there. Rays without a
    depth are sampled to the end of the scene. Our choice; NICE-SLAM and its followers do alike.
    """
    exit_depth = rays_end(rays, bounds)
    measured = rays.depth > 0
    behind_surface = rays.depth + config.surface_band
    far = torch.where(measured, behind_surface, exit_depth)
    spread = stratified_depths(NEAR, far, config.n_stratified, generator)
    around = stratified_depths(-1.0, torch.ones_like(far), config.n_surface, generator)
    center = torch.where(measured, rays.depth, exit_depth)
    around = (center[:, None] + config.surface_band * around).clamp_min(NEAR)
    return torch.cat([spread, around], dim=-1).sort(dim=-1).values


@torch.no_grad()
def two_pass_depths(
    field: LearnedField,
    rays: Rays,
    n_stratified: int,
    n_importance: int,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "rays samples"]:
    """Ascending sample depths (m) that need no measurement: iMAP's two passes.

    The first pass renders `n_stratified` samples between the camera and the end of the scene; the
    second adds `n_importance` where that found something. Without a generator nothing is random.
    Source: iMAP, Sec. 3.2 (32 and 12 samples).
    """
    spread = stratified_depths(NEAR, rays_end(rays, field.bounds), n_stratified, generator)
    weights = _of_samples(field.render(rays, spread).weights, spread)
    extra = importance_depths(spread, weights, n_importance, generator)
    return torch.cat([spread, extra], dim=-1).sort(dim=-1).values


def render_in_two_passes(
    field: LearnedField,
    rays: Rays,
    n_stratified: int,
    n_importance: int,
    generator: torch.Generator | None = None,
) -> Rendering:
    """What `two_pass_depths` and rendering there give, with every sample asked for once.

    The second pass of the plain formulation asks again for the samples of the first; their answers
    are the same, and a third of the work.
    """
    with torch.no_grad():  # where samples lie is given: a pose does not move them along
        spread = stratified_depths(NEAR, rays_end(rays, field.bounds), n_stratified, generator)
    colors, values = field.along(rays, spread)
    with torch.no_grad():
        weights = _of_samples(field.composite(colors, values, rays, spread).weights, spread)
        extra = importance_depths(spread, weights, n_importance, generator)
    more_colors, more_values = field.along(rays, extra)
    depths, order = torch.cat([spread, extra], dim=-1).sort(dim=-1)
    colors = torch.cat([colors, more_colors], dim=1)
    colors = colors.gather(1, order[..., None].expand_as(colors))
    values = torch.cat([values, more_values], dim=-1).gather(-1, order)
    return field.composite(colors, values, rays, depths)


def _of_samples(
    weights: Float[Tensor, "rays sections"], depths: Float[Tensor, "rays samples"]
) -> Float[Tensor, "rays samples"]:
    """Weights of samples; NeuS weighs the sections between them, of which both ends get a share."""
    if weights.shape[1] == depths.shape[1]:
        return weights
    pad = torch.nn.functional.pad
    return pad(weights, (0, 1)) + pad(weights, (1, 0))


def rays_end(rays: Rays, bounds: SceneBounds) -> Float[Tensor, "rays"]:
    """Z-depth (m) at which rays leave the scene, at least a little in front of the camera."""
    exit_depth = bounds.exit_depth(rays.origins_world, rays.directions_world)
    return exit_depth.clamp_min(2 * NEAR)
