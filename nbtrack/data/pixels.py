"""Random pixels of a sequence as rays."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nbtrack.core.camera import backproject, pixel_directions
from nbtrack.core.device import has_room_for
from nbtrack.data.sequence import MILLIMETRE, RgbdSequence

# Tangent planes: how far away neighbours are, as a share of the image's width, and by how much of
# the depth they may differ, which cuts off edges and incidences above some 75 degrees (our choice).
_PLANE_REACH, _PLANE_JUMP = 1 / 64, 0.1
# Points to track: a neighbouring depth that differs by more, as a share, marks an edge.
_EDGE_JUMP = 0.05
_DRAWN_PER_POINT = 4


@dataclass(frozen=True)
class Rays:
    """Rays through pixels, with what the camera measured there."""

    origins_world: Float[Tensor, "rays 3"]
    directions_world: Float[Tensor, "rays 3"]  # z = 1 in the camera frame: steps are z-depths
    color: Float[Tensor, "rays 3"]  # measured, in [0, 1]
    depth: Float[Tensor, "rays"]  # measured z-depth (m), 0 = no measurement
    # Distance (m) from the measured surface's tangent plane that one metre of z-depth makes: below
    # the ray's length by the cosine of incidence. 0 where not known; None where not asked for.
    plane_distance_per_depth: Float[Tensor, "rays"] | None = None

    def points(self, depths: Float[Tensor, "rays samples"]) -> Float[Tensor, "rays samples 3"]:
        """World points (m) at z-depths along the rays."""
        return self.origins_world[:, None] + depths[..., None] * self.directions_world[:, None]


class PixelSampler:
    """Draws measured pixels of a sequence, for a network on some device.

    Images stay 8 and 16 bit; only drawn pixels become floating point, so that a long sequence of
    full-size frames fits a laptop's memory. The images lie on the device too if it has room to
    spare, else on the host, from where drawn pixels travel; what is drawn is the same.
    """

    def __init__(
        self,
        sequence: RgbdSequence,
        device: torch.device,
        images_device: torch.device | None = None,
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

    def show(self, sequence: RgbdSequence) -> None:
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
