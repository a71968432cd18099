"""Draws random pixels of a sequence, as rays with what the camera measured."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.core.arrays import Colors, Indices, Points, RaySamples, Values
from nbtrack.core.camera import backproject, pixel_directions
from nbtrack.data.frame import as_floats
from nbtrack.data.sequence import RgbdSequence
from nbtrack.machinery.device import has_room_for
from nbtrack.machinery.inputs import tensor_of

# The neighbours that a pixel's tangent plane is computed from (our choice): how far away they are,
# as a share of the image's width, and by what share of the pixel's depth they may differ from it.
# This leaves out pixels at edges, and surfaces seen at more than some 79 degrees from their normal
# (if the image is 60 degrees wide).
PLANE_REACH = 1 / 64
PLANE_JUMP = 0.1


@dataclass(frozen=True)
class Rays:
    """Rays through pixels, with what the camera measured there."""

    origins_world: Float[Tensor, "rays 3"]
    directions_world: Float[Tensor, "rays 3"]  # with z = 1 in the camera frame
    color: Float[Tensor, "rays 3"]  # measured, in [0, 1]
    depth: Float[Tensor, "rays"]  # measured z-depth (m), 0 = no measurement
    # Unit normals of the measured surface, towards the camera; 0 where unknown. None if they were
    # not asked for.
    normals_world: Float[Tensor, "rays 3"] | None = None

    def points(self, depths: RaySamples) -> Float[Tensor, "rays samples 3"]:
        """World points (m) at z-depths along the rays."""
        return self.origins_world[:, None] + depths[..., None] * self.directions_world[:, None]


class PixelSampler:
    """Draws random pixels of a sequence as rays on a device, also pixels without measurement.

    The images stay integers; only drawn pixels become floating point. Images are kept on the device
    if it has enough memory, else on the host. This does not change what is drawn.
    """

    def __init__(self, sequence: RgbdSequence, device: torch.device) -> None:
        """Take the sequence and the device on which rays are needed."""
        n_bytes = sequence.colors.nbytes + sequence.depths_mm.nbytes
        self.device = device
        self.intrinsics = sequence.intrinsics
        images_device = device if has_room_for(device, n_bytes) else torch.device("cpu")
        self.colors = tensor_of(sequence.colors).to(images_device)
        # Few torch kernels take unsigned 16-bit integers, so the bits are kept as signed ones.
        self.depths_mm = tensor_of(sequence.depths_mm).view(torch.int16).to(images_device)
        self.T_world_camera = tensor_of(sequence.T_world_camera).float().to(device)

    def rays(self, frames: Indices, rows: Indices, columns: Indices) -> Rays:
        """Rays through given pixels, with what was measured there and without normals."""
        color, depth = self.at(frames, rows, columns)
        T_world_camera = self.T_world_camera[frames]
        directions_camera = pixel_directions(self.intrinsics, columns, rows)
        directions_world = (T_world_camera[:, :3, :3] @ directions_camera[..., None]).squeeze(-1)
        return Rays(T_world_camera[:, :3, 3], directions_world, color, depth)

    def normals_camera(self, frames: Indices, rows: Indices, columns: Indices) -> Points:
        """Unit normals of the surface at pixels, in the camera frame and towards the camera.

        The tangent plane is computed from the neighbours to the left, right, top and bottom. These
        are some pixels away, so that noise tilts the plane little. The normal is 0 if the pixel or
        a neighbour has no measured depth, or if a neighbour lies outside of the image or on another
        surface.
        """
        _, height, width = self.depths_mm.shape
        reach = max(1, round(width * PLANE_REACH))  # pixels
        _, depth = self.at(frames, rows, columns)
        points = {}  # of the neighbours, by side (m, camera frame)
        is_known = depth > 0
        steps = {"left": (0, -reach), "right": (0, reach), "up": (-reach, 0), "down": (reach, 0)}
        for side, (row_step, column_step) in steps.items():
            row, column = rows + row_step, columns + column_step
            is_known &= (row >= 0) & (row < height) & (column >= 0) & (column < width)
            row, column = row.clamp(0, height - 1), column.clamp(0, width - 1)
            _, side_depth = self.at(frames, row, column)
            is_known &= (side_depth > 0) & ((side_depth - depth).abs() < PLANE_JUMP * depth)
            points[side] = backproject(self.intrinsics, column, row, side_depth)
        # Right (x) cross up (-y) is -z, which points towards the camera.
        normal = torch.linalg.cross(points["right"] - points["left"], points["up"] - points["down"])
        return torch.nn.functional.normalize(normal, dim=-1) * is_known[:, None]

    def at(self, frames: Indices, rows: Indices, columns: Indices) -> tuple[Colors, Values]:
        """Colour in [0, 1] and z-depth (m, 0 = no measurement) of pixels."""
        pixels = tuple(indices.to(self.colors.device) for indices in (frames, rows, columns))
        depth_mm = self.depths_mm[pixels].to(self.device).int() & 0xFFFF  # unsigned again
        return as_floats(self.colors[pixels].to(self.device), depth_mm)

    def draw(
        self, n_rays: int, generator: torch.Generator, frames: Indices, tangent_planes: bool = False
    ) -> Rays:
        """Rays through random pixels of the given frames. A pixel without measurement has depth 0.

        With `tangent_planes` the rays have normals, which are 0 where unknown.
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
