"""A box seen from inside: a field whose answers are known exactly, and exact images of it."""

import numpy as np
import torch
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics, pixel_directions
from nbtrack.data.pixels import Rays
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields.base import LearnedField
from nbtrack.fields.rendering import Rendering, composite, weights_from_density

SHIFT = 0.03  # m behind the wall at which the density is half its largest


class BoxRoom(LearnedField):
    """The inside of a box with smoothly coloured walls; as a distance or as a steep density."""

    name, label, surface_level = "box", "box", 0.0
    mapping_losses = None  # not asked for

    def __init__(self, as_density=False, half=(1.0, 0.8, 1.2), contrast=0.4) -> None:
        """Of half sides in metres."""
        edges = tuple(side + 0.1 for side in half)
        super().__init__(SceneBounds(tuple(-edge for edge in edges), edges))
        self.as_density, self.half, self.contrast = as_density, torch.tensor(half), contrast

    def color(self, points_world: Tensor) -> Tensor:
        return 0.5 + self.contrast * torch.sin(3 * points_world)

    def forward(self, points_world: Tensor) -> tuple[Tensor, Tensor]:
        sdf = (self.half - points_world.abs()).amin(dim=-1)
        # Light goes out at the wall on average: the shift was solved for numerically.
        value = 150 * torch.sigmoid((-sdf - SHIFT) / 0.02) if self.as_density else sdf
        return self.color(points_world), value

    def composite(self, colors: Tensor, values: Tensor, rays: Rays, depths: Tensor) -> Rendering:
        lengths = rays.directions_world.norm(dim=-1)
        return composite(weights_from_density(values, depths, lengths), colors, depths)


def box_sequence(
    offsets: list[list[float]], room: BoxRoom | None = None, height: int = 24
) -> RgbdSequence:
    """Exact images of a box room from cameras at offsets (m) from the middle, not rotated."""
    room, width = room or BoxRoom(), height * 4 // 3
    camera = Intrinsics.from_focal(width, height, float(height))
    rows, columns = torch.ones(height, width).nonzero().T.view(2, height, width)
    directions = pixel_directions(camera, columns, rows)
    poses = np.tile(np.eye(4), (len(offsets), 1, 1))
    poses[:, :3, 3] = offsets
    offset = torch.tensor(offsets, dtype=torch.float32)[:, None, None]
    depth = ((room.half * directions.sign() - offset) / directions).amin(dim=-1)
    color = room.color(offset + depth[..., None] * directions)
    colors, depths = (255 * color).round().byte().numpy(), (1000 * depth).round().numpy()
    frame_ids = np.arange(len(offsets))
    return RgbdSequence("box", camera, colors, depths.astype(np.uint16), poses, frame_ids)


def walk(n_frames: int, *room_and_height: BoxRoom | int) -> RgbdSequence:
    """A camera that moves by 4 mm a frame."""
    offsets = [[0.0036 * i, 0.0, 0.0018 * i] for i in range(n_frames)]
    return box_sequence(offsets, *room_and_height)


def narrow_room() -> BoxRoom:
    """One of which the camera sees five walls: they hold its pose without their colours."""
    return BoxRoom(half=(0.6, 0.45, 1.2))
