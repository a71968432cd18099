"""Random pixels of a sequence as rays."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.core.arrays import Colors, Indices, Points, RaySamples, Values
from nbtrack.core.camera import backproject, pixel_directions
from nbtrack.data.frame import measured
from nbtrack.data.sequence import RgbdSequence
from nbtrack.machinery.device import has_room_for
from nbtrack.machinery.inputs import tensor_of

# Tangent planes: how far away neighbours are, as a share of the image's width, and by how much of
# the depth they may differ, which cuts off edges and incidences above some 75 degrees (our choice).
PLANE_REACH = 1 / 64
PLANE_JUMP = 0.1


@dataclass(frozen=True)
class Rays:
    """Rays through pixels, with what the camera measured there."""

    origins_world: Float[Tensor, "rays 3"]
    directions_world: Float[Tensor, "rays 3"]  # z = 1 in the camera frame: steps are z-depths
    color: Float[Tensor, "rays 3"]  # measured, in [0, 1]
    depth: Float[Tensor, "rays"]  # measured z-depth (m), 0 = no measurement
    # Unit normal of the measured surface, towards the camera; 0 where not known, None where not
    # asked for. One metre of z-depth leads |normal . direction| metres away from the plane.
    normals_world: Float[Tensor, "rays 3"] | None = None

    def points(self, depths: RaySamples) -> Float[Tensor, "rays samples 3"]:
        """World points (m) at z-depths along the rays."""
        return self.origins_world[:, None] + depths[..., None] * self.directions_world[:, None]


class PixelSampler:
    """Draws random pixels of a sequence, measured or not, for a network on some device.

    Only drawn pixels become floating point. The images lie on the device too if it has room to
    spare, else on the host, from where drawn pixels travel; what is drawn is the same.
    """

    def __init__(self, sequence: RgbdSequence, device: torch.device) -> None:
        n_bytes = sequence.colors.nbytes + sequence.depths_mm.nbytes
        self.device = device
        self.intrinsics = sequence.intrinsics
        images_device = device if has_room_for(device, n_bytes) else torch.device("cpu")
        self.colors = tensor_of(sequence.colors).to(images_device)
        # Few torch kernels know unsigned 16 bit: the same bits travel as signed.
        self.depths_mm = tensor_of(sequence.depths_mm).view(torch.int16).to(images_device)
        self.T_world_camera = tensor_of(sequence.T_world_camera).float().to(device)

    def rays(self, frames: Indices, rows: Indices, columns: Indices) -> Rays:
        """Rays through given pixels, with their measurements."""
        color, depth = self.measured(frames, rows, columns)
        T_world_camera = self.T_world_camera[frames]
        directions_camera = pixel_directions(self.intrinsics, columns, rows)
        directions_world = (T_world_camera[:, :3, :3] @ directions_camera[..., None]).squeeze(-1)
        return Rays(T_world_camera[:, :3, 3], directions_world, color, depth)

    def normals_camera(self, frames: Indices, rows: Indices, columns: Indices) -> Points:
        """Unit normals of the surface at pixels, in the camera frame and towards the camera.

        The tangent plane goes through neighbours to all sides, some pixels away, so that noise
        tilts it little. 0 where the pixel or one of these is not measured, or where one lies on
        another surface.
        """
        _, height, width = self.depths_mm.shape
        reach = max(1, round(width * PLANE_REACH))  # pixels
        _, depth = self.measured(frames, rows, columns)
        points = {}  # m, camera frame
        is_whole = depth > 0
        steps = {"left": (0, -reach), "right": (0, reach), "up": (-reach, 0), "down": (reach, 0)}
        for side, (row_step, column_step) in steps.items():
            row, column = rows + row_step, columns + column_step
            is_whole &= (row >= 0) & (row < height) & (column >= 0) & (column < width)
            row, column = row.clamp(0, height - 1), column.clamp(0, width - 1)
            _, side_depth = self.measured(frames, row, column)
            is_whole &= (side_depth > 0) & ((side_depth - depth).abs() < PLANE_JUMP * depth)
            points[side] = backproject(self.intrinsics, column, row, side_depth)
        # Rightwards cross upwards: x cross -y is -z, towards the camera.
        normal = torch.linalg.cross(points["right"] - points["left"], points["up"] - points["down"])
        return torch.nn.functional.normalize(normal, dim=-1) * is_whole[:, None]

    def measured(self, frames: Indices, rows: Indices, columns: Indices) -> tuple[Colors, Values]:
        """Colour in [0, 1] and z-depth (m, 0 = none) of pixels."""
        where = tuple(indices.to(self.colors.device) for indices in (frames, rows, columns))
        depth_mm = self.depths_mm[where].to(self.device).int() & 0xFFFF  # unsigned again
        return measured(self.colors[where].to(self.device), depth_mm)

    def draw(
        self, n_rays: int, generator: torch.Generator, frames: Indices, tangent_planes: bool = False
    ) -> Rays:
        """Rays through random pixels of the given frames, measured or not (depth 0).

        With `tangent_planes` they have normals, which are 0 where not known.
        """

        def below(limit: int) -> Indices:
            return torch.randint(limit, (n_rays,), generator=generator, device=generator.device)

        _, height, width = self.depths_mm.shape
        drawn = frames[below(len(frames))]
        rows, columns = below(height), below(width)
        rays = self.rays(drawn, rows, columns)
        if not tangent_planes:
            return rays
        normals_camera = self.normals_camera(drawn, rows, columns)
        normals_world = self.T_world_camera[drawn, :3, :3] @ normals_camera[..., None]
        return replace(rays, normals_world=normals_world.squeeze(-1))
