"""Fields whose answers are known exactly, among them a box seen from inside; and exact images."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics, pixel_directions
from nbtrack.data.frame import Frame
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields.base import LearnedField
from nbtrack.fields.rendering import weights_from_density, weights_from_sdf
from nbtrack.synthetic import build_room, handheld_trajectory, render_frame, room_intrinsics
from nbtrack.tracking.tracker import Estimate

SHIFT = 0.03  # m behind the wall at which the density is half its largest


def grey(points_world: Tensor) -> Tensor:
    return torch.full_like(points_world, 0.5)


class Formula(LearnedField):
    """A distance (m) or density (1/m) and a colour, by formulas of points (n x 3)."""

    name, label, surface_level = "formula", "Formula", 0.0
    mapping_losses = None  # not asked for

    def __init__(self, value, bounds: SceneBounds, color=grey, as_density: bool = False) -> None:
        super().__init__(bounds)
        self.value, self.color, self.as_density = value, color, as_density

    def forward(self, points_world: Tensor) -> tuple[Tensor, Tensor]:
        return self.color(points_world), self.value(points_world)

    def weights(self, values: Tensor, rays, depths: Tensor) -> Tensor:
        if self.as_density:
            return weights_from_density(values, depths, rays.directions_world.norm(dim=-1))
        return weights_from_sdf(values, torch.tensor(50.0))


class BoxRoom(Formula):
    """The inside of a box with smoothly coloured walls; as a distance or as a steep density."""

    name = label = "box"

    def __init__(self, as_density=False, half=(1.0, 0.8, 1.2), contrast=0.4) -> None:
        """Of half sides in metres."""
        self.half = torch.tensor(half)

        def distance(points: Tensor) -> Tensor:
            return (self.half - points.abs()).amin(dim=-1)

        def density(points: Tensor) -> Tensor:
            # Light goes out at the wall on average: the shift was solved for numerically.
            return 150 * torch.sigmoid((-distance(points) - SHIFT) / 0.02)

        def color(points: Tensor) -> Tensor:
            return 0.5 + contrast * torch.sin(3 * points)

        edges = tuple(side + 0.1 for side in half)
        bounds = SceneBounds(tuple(-edge for edge in edges), edges)
        super().__init__(density if as_density else distance, bounds, color, as_density)


def poses_at(positions, turns=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Poses (n x 4 x 4) at positions (n x 3, m), turned by one rotation vector (rad) or by n."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    poses[:, :3, 3] = positions
    return poses


def sequence_of(
    depths_mm: np.ndarray, camera: Intrinsics, colors=None, poses=None, name="room"
) -> RgbdSequence:
    """Depth maps (frames, height, width) with grey images, from the origin along z, if not said."""
    n, *size = depths_mm.shape
    colors = np.full((n, *size, 3), 128, np.uint8) if colors is None else colors
    poses = poses_at(np.zeros((n, 3))) if poses is None else poses
    depths_mm = depths_mm.round().astype(np.uint16)
    return RgbdSequence(name, camera, colors, depths_mm, poses, np.arange(n), np.arange(n) / 30)


def box_sequence(places, room: BoxRoom | None = None, height: int = 24) -> RgbdSequence:
    """Exact images of a box room, from offsets (n x 3, m) of its middle or poses (n x 4 x 4)."""
    room, width, poses = room or BoxRoom(), height * 4 // 3, np.asarray(places, dtype=float)
    if poses.ndim == 2:
        poses = poses_at(places)
    camera = Intrinsics.from_focal(width, height, float(height))
    rows, columns = torch.ones(height, width).nonzero().T.view(2, height, width)
    T_world_camera = torch.from_numpy(poses).float()[:, None, None]
    directions = pixel_directions(camera, columns, rows)
    rays = (T_world_camera[..., :3, :3] @ directions[..., None])[..., 0]
    origin = T_world_camera[..., :3, 3]
    depth = ((room.half * rays.sign() - origin) / rays).amin(dim=-1)
    colors = (255 * room.color(origin + depth[..., None] * rays)).round().byte().numpy()
    return sequence_of(1000 * depth.numpy(), camera, colors, poses, "box")


def room_sequence(name: str, width: int, n_frames: int, stride: int = 1) -> RgbdSequence:
    """What a hand-held camera sees of a furnished room, with clean depth."""
    room, camera = build_room(name), room_intrinsics(width, width * 3 // 4)
    poses = handheld_trajectory(room, n_frames * stride, 0)[::stride]
    colors, depths, _ = zip(*(render_frame(room, camera, pose) for pose in poses), strict=True)
    return sequence_of(1000 * np.stack(depths), camera, np.stack(colors), poses)


def walk(n_frames: int, *room_and_height: BoxRoom | int) -> RgbdSequence:
    """A camera that moves by 4 mm a frame."""
    return box_sequence([[0.0036 * i, 0.0, 0.0018 * i] for i in range(n_frames)], *room_and_height)


def narrow_room() -> BoxRoom:
    """One of which the camera sees five walls: they hold its pose without their colours."""
    return BoxRoom(half=(0.6, 0.45, 1.2))


def error_m(found: Estimate, frame: Frame) -> float:
    """How far the estimate is from where the frame was taken."""
    return float(np.linalg.norm(found.T_world_camera[:3, 3] - frame.T_world_camera[:3, 3]))


PLANES = {  # how far (m) they lie in a direction; and whether they hold a camera without colours
    "wall": ({(0, 0, 1): 1.5}, False),
    "floor": ({(0, 1, 0): 1.0}, False),
    "corridor": ({(1, 0, 0): 0.8, (-1, 0, 0): 0.9, (0, 1, 0): 1.0}, False),
    "corner": ({(1, 0, 0): 0.8, (0, 1, 0): 1.0, (0, 0, 1): 1.5}, True),
}


def plane_depths(planes: dict[tuple[int, ...], float], rays: np.ndarray) -> np.ndarray:
    """Z-depths (m) of planes along rays (... x 3, z = 1) from the origin; infinite for none."""
    closeness = np.max([rays @ normal / far for normal, far in planes.items()], axis=0)
    with np.errstate(divide="ignore"):
        return 1 / closeness.clip(0)
