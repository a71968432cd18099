"""Random pixels of a sequence as rays, and where along the rays to look."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nbtrack.bounds import SceneBounds
from nbtrack.camera import pixel_directions
from nbtrack.config import MappingConfig
from nbtrack.data import MILLIMETRE, Sequence
from nbtrack.device import has_room_for
from nbtrack.fields.base import Field, Rays
from nbtrack.rendering import importance_depths, stratified_depths

NEAR = 0.05  # m, z-depth before which nothing is looked for: closer than any depth camera measures


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

    def measurements(
        self, frames: Int[Tensor, "n"], rows: Int[Tensor, "n"], columns: Int[Tensor, "n"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Colour in [0, 1] and z-depth (m, 0 = none) of pixels."""
        where = tuple(index.to(self.images_device) for index in (frames, rows, columns))
        color = self.colors[where].to(self.device).float() / 255
        depth_mm = self.depths_mm[where].to(self.device).int() & 0xFFFF
        return color, depth_mm.float() * MILLIMETRE

    def draw(
        self, n_rays: int, generator: torch.Generator, frames: Int[Tensor, "frames"]
    ) -> Rays:
        """Rays through pixels drawn uniformly over the given frames."""
        _, height, width = self.depths_mm.shape
        chosen, rows, columns = (
            torch.randint(limit, (n_rays,), generator=generator, device=generator.device)
            for limit in (len(frames), height, width)
        )
        return self.rays(frames[chosen], rows, columns)

    def measured_pixels(self, frame: int) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
        """Rows and columns of all pixels of one frame that have a depth."""
        rows, columns = torch.nonzero(self.depths_mm[frame], as_tuple=True)
        return rows.to(self.device), columns.to(self.device)


def mapping_depths(
    field: Field, rays: Rays, config: MappingConfig, generator: torch.Generator
) -> Float[Tensor, "rays samples"]:
    """Ascending sample depths (m) for a field's mapping: by its own wish, guided or not."""
    if field.depth_guided:
        return guided_depths(rays, field.bounds, config, generator)
    return two_pass_depths(field, rays, config.n_stratified, config.n_surface, generator)


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
    field: Field,
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
    weights = field.render(rays, spread).weights
    # NeuS weighs the sections between samples: both their ends get a share.
    if weights.shape[1] < spread.shape[1]:
        pad = torch.nn.functional.pad
        weights = pad(weights, (0, 1)) + pad(weights, (1, 0))
    extra = importance_depths(spread, weights, n_importance, generator)
    return torch.cat([spread, extra], dim=-1).sort(dim=-1).values


def rays_end(rays: Rays, bounds: SceneBounds) -> Float[Tensor, "rays"]:
    """Z-depth (m) at which rays leave the scene, at least a little in front of the camera."""
    exit_depth = bounds.exit_depth(rays.origins_world, rays.directions_world)
    return exit_depth.clamp_min(2 * NEAR)
