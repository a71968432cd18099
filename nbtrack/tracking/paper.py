"""The paper's two trackers, and the class of trackers that minimise a loss with Adam."""

import abc
from dataclasses import dataclass, replace

import torch

from nbtrack.core import geometry
from nbtrack.core.arrays import Colors, Points, Scalar, Transform, Transforms, Values
from nbtrack.core.camera import pixel_directions
from nbtrack.data.frame import Frame
from nbtrack.data.pixels import Rays
from nbtrack.fields.base import rendered_losses
from nbtrack.machinery.launches import RepeatedWork, make_adam
from nbtrack.machinery.settings import limited, one_of
from nbtrack.tracking.reach import Reach, reach
from nbtrack.tracking.tracker import Tracker, TrackerSettings


@dataclass(frozen=True)
class AdamSettings(TrackerSettings):
    """Adam's learning rates (paper, implementation details).

    The paper does not say in which unit its positions are. With metres a camera could not move far
    enough in two cells of its Table I (`tracking.reach`), so the default is the unit of the map
    (notebook A1).
    """

    position_rate: float = 5e-4  # of the position, in `position_unit`
    position_unit: str = one_of("map", "metre")
    orientation_rate: float = 1e-3  # of the unit quaternion

    def position_rate_m(self, metres_per_unit: float) -> float:
        """The learning rate of the position in metres, if a unit of the map is so many metres."""
        return self.position_rate * (metres_per_unit if self.position_unit == "map" else 1.0)

    def reach(self, steps: float, metres_per_unit: float) -> Reach:
        """How far a frame's search can move and turn the camera.

        A turn by a small angle moves the unit quaternion by half of this angle. The reach is that
        of one component: a turn that moves all four alike may be up to twice as large.
        """
        position = reach(steps, self.position_rate_m(metres_per_unit))
        return Reach(position, 2 * reach(steps, self.orientation_rate))


class AdamTracker(Tracker):
    """Minimises a loss over position and unit quaternion with Adam, on new pixels in every step.

    A subclass defines the `loss`. Source: paper, implementation details. Adam's state is reset for
    each frame: momentum of the frame before would move the pose on although the camera stands still
    (our choice).
    """

    Settings = AdamSettings
    # Holds a copy of the current frame's images; its name and pose are those of the first frame.
    frame: Frame | None = None

    @abc.abstractmethod
    def loss(
        self, T_world_camera: Transform, directions_camera: Points, color: Colors, depth: Values
    ) -> Scalar:
        """The loss of pixels at a pose. Pixels have directions (z = 1), colours and z-depths (m).

        Colours are in [0, 1]. On CUDA the loss is recorded in the third step, and replayed from
        then on. So whatever else it depends on, and changes between steps, must be in tensors.
        """

    def begin(self, frame: Frame, T_starts: Transforms) -> None:
        """Start a frame's search at the pose with the lowest loss, computed on the same pixels."""
        if self.frame is None or self.frame.camera != frame.camera:
            self._allocate(frame)
        # All that steps read is written in place: on CUDA the recorded step reads these tensors.
        self.frame.color.copy_(frame.color)
        self.frame.depth_mm.copy_(frame.depth_mm)
        self.measured_pixels = frame.measured_pixels()
        T_starts = T_starts.to(self.device, torch.float32)
        T_start = T_starts[0]
        with torch.no_grad():
            if len(T_starts) > 1:
                self._choose_pixels()
                losses = torch.stack([self._loss_at(T) for T in T_starts])
                T_start = T_starts[losses.nan_to_num(torch.inf).argmin()]  # NaN is no best start
            self.position.copy_(T_start[:3, 3])
            self.q_wxyz.copy_(geometry.matrix_to_quaternion(T_start[:3, :3]))
            for moments in self.optimizer.state.values():  # Adam's moments and number of steps
                for value in moments.values():
                    value.zero_()

    def step(self) -> Scalar:
        """Draw pixels and take one step of Adam on their loss; returns the loss before the step."""
        self._choose_pixels()
        return self.descent.run(self._descend)

    def _allocate(self, frame: Frame) -> None:
        """Allocate all tensors that steps read and change, for frames of one camera."""
        self.frame = replace(frame, color=frame.color.clone(), depth_mm=frame.depth_mm.clone())
        self.pixels = torch.empty(2, self.settings.n_pixels, dtype=torch.int64, device=self.device)
        searched = {"dtype": torch.float32, "device": self.device, "requires_grad": True}
        self.position, self.q_wxyz = torch.zeros(3, **searched), torch.zeros(4, **searched)
        position_rate = self.settings.position_rate_m(self.field.bounds.metres_per_unit)
        position = {"params": [self.position], "lr": position_rate}
        orientation = {"params": [self.q_wxyz], "lr": self.settings.orientation_rate}
        self.optimizer = make_adam([position, orientation], self.device)
        self.descent = RepeatedWork(f"tracker {self.name}", self.generator)

    def _descend(self) -> Scalar:
        """Take one step of Adam on the chosen pixels; returns the loss before it."""
        self.optimizer.zero_grad()
        loss = self._loss_at(self.T_world_camera)
        loss.backward()
        self.optimizer.step()
        with torch.no_grad():
            self.q_wxyz.div_(self.q_wxyz.norm(dim=-1, keepdim=True))
        return loss.detach()

    def _choose_pixels(self) -> None:
        """Choose `n_pixels` random pixels among the measured ones, with replacement.

        The number of measured pixels differs from frame to frame, so the choice cannot be recorded.
        """
        n_measured, size = self.measured_pixels.shape[1], (self.settings.n_pixels,)
        chosen = torch.randint(n_measured, size, generator=self.generator, device=self.device)
        torch.index_select(self.measured_pixels, 1, chosen, out=self.pixels)

    def _loss_at(self, T_world_camera: Transform) -> Scalar:
        """The loss of the chosen pixels at a pose."""
        rows, columns = self.pixels
        directions_camera = pixel_directions(self.frame.camera, columns, rows)
        color, depth = self.frame.at(rows, columns)
        return self.loss(T_world_camera, directions_camera, color, depth)

    @property
    def T_world_camera(self) -> Transform:
        """The current estimate, through which gradients flow to position and quaternion."""
        return geometry.make_transform(geometry.quaternion_to_matrix(self.q_wxyz), self.position)


@dataclass(frozen=True)
class VrSettings(AdamSettings):
    """Settings of tracking by volume rendering."""

    n_pixels: int = limited(512, 1, 65536)  # (paper)
    lambda_color: float = 5.0  # (iMAP)
    lambda_depth: float = 1.0  # with 0 colour alone counts, at the same pixels (iNeRF)
    # Samples of the first pass (iMAP). The rendered depth of a single one has no gradient.
    n_stratified: int = limited(32, 2, 1024)
    n_importance: int = limited(12, 0, 1024)  # samples of the second pass (iMAP)


class VrTracker(AdamTracker):
    """Matches rendered with measured colour and depth. Paper, Sec. II-B.1; iMAP, Sec. 3.3."""

    name = "vr"
    Settings = VrSettings
    renders = True

    def loss(
        self, T_world_camera: Transform, directions_camera: Points, color: Colors, depth: Values
    ) -> Scalar:
        """iMAP's loss of rendered pixels; gradients flow to the pose through all samples."""
        rotation, position = T_world_camera[:3].split([3, 1], dim=1)
        directions_world = directions_camera @ rotation.T
        rays = Rays(position.T.expand_as(directions_world), directions_world, color, depth)
        n_first, n_second = self.settings.n_stratified, self.settings.n_importance
        rendered = self.field.render_hierarchically(rays, n_first, n_second, self.generator)
        lambda_color, lambda_depth = self.settings.lambda_color, self.settings.lambda_depth
        terms = rendered_losses(rendered, rays, lambda_color, lambda_depth, over_std=True)
        return terms["depth"] + terms["color"]


@dataclass(frozen=True)
class SdfSettings(AdamSettings):
    """Settings of tracking by signed distances. The paper gives no weights."""

    lambda_sdf: float = 1.0  # per metre
    lambda_color: float = 0.3


class SdfTracker(AdamTracker):
    """Moves measured points onto the zero level of the signed distance. Paper, Sec. II-B.2."""

    name = "sdf"
    Settings = SdfSettings

    def loss(
        self, T_world_camera: Transform, directions_camera: Points, color: Colors, depth: Values
    ) -> Scalar:
        """The loss of the pixels' back-projected points. Source: paper, Eq. 2."""
        points_camera = directions_camera * depth[:, None]
        points_world = geometry.transform_points(T_world_camera, points_camera)
        field_color, field_sdf = self.field(points_world)
        settings = self.settings
        return sdf_loss(field_sdf, field_color, color, settings.lambda_sdf, settings.lambda_color)


def sdf_loss(
    field_sdf: Values, field_color: Colors, color: Colors, lambda_sdf: float, lambda_color: float
) -> Scalar:
    """The loss lambda_sdf mean|d| + lambda_color mean|c - c_observed| of measured points.

    d (`field_sdf`, m) and c (`field_color`, in [0, 1]) are the field's distances and colours at the
    points; c_observed (`color`) are the measured colours. The second mean is over points and
    channels. Source: paper, Eq. 2.

    >>> import torch
    >>> zeros = torch.zeros(2, 3)
    >>> sdf_loss(torch.tensor([0.1, -0.3]), zeros, zeros + 0.5, 1.0, 0.1).item()
    0.25
    """
    return lambda_sdf * field_sdf.abs().mean() + lambda_color * (field_color - color).abs().mean()
