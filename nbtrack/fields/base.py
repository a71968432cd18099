"""The base classes of fields, through which mapping and tracking use them; rendering losses."""

import abc
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Generator, Tensor, nn

from nbtrack.core.arrays import Colors, Frames, Points, Pose, RayColors, RaySamples, Scalar, Values
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics, pixel_directions
from nbtrack.data.pixels import Rays
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import rendering
from nbtrack.fields.mlp import NetworkSettings
from nbtrack.fields.rendering import Rendering, Weights
from nbtrack.machinery.device import usual_modes
from nbtrack.machinery.errors import typed
from nbtrack.machinery.inputs import check_array, checked_pose
from nbtrack.machinery.settings import MANY, limited

# The smallest standard deviation (m) that a depth error is divided by. Without a limit a ray with a
# very sharp surface would outweigh all others (our choice; depth noise is of this size).
MIN_STD = 0.02
NEAR = 0.05  # m, z-depth of the nearest sample: closer than any depth camera measures

# Samples on each ray of a rendered image, for both passes. They are more than in mapping and not
# random, so that equal calls give equal images.
_N_STRATIFIED = 48
_N_IMPORTANCE = 24
_RAYS_AT_ONCE = 4096  # rays of an image that are rendered together, which bounds memory

Losses = dict[str, Scalar]
State = dict[str, Tensor]
# A rendered image: colours in [0, 1] and z-depths (m).
View = tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width"]]
# A function that draws random rays of the mapped frames. It takes the number of rays and,
# optionally, `tangent_planes`; `PixelSampler.draw` explains both.
Draw = Callable[..., Rays]


@dataclass(frozen=True)
class MappingSettings:
    """Settings of fitting a field to posed frames. The paper gives none of these values."""

    iterations: int = 20_000
    n_rays: int = limited(1024, 1, 65536)  # batch size; rays are drawn over all mapped frames
    # Stratified samples on each ray (iMAP). The rendered depth of a single one has no gradient.
    n_stratified: int = limited(32, 2, 1024)
    # Samples near the surface on each ray: iMAP's second pass, or NeuS's around the measured depth.
    n_surface: int = limited(12, 0, 1024)
    learning_rate: float = 1e-3  # Adam's at the start; it falls along a cosine to 1/20 (NeuS)
    lambda_color: float = 5.0  # iMAP's, beside depth errors that are divided by their std
    holdout_every: int = limited(10, 0, MANY)  # every n-th frame is not mapped, only scored
    tf32: bool = False  # matrix products in TF32, on NVIDIA's GPUs


class Field(nn.Module, abc.ABC):
    """A scene as a function of position: a colour, and a value that tells where surfaces are."""

    name: str  # on the command line and in file names
    label: str  # in tables and figures
    # The name in `FORMS` of a class that is made from mapped fields, such as corrected maps; empty
    # for fields that mapping makes.
    form: str = ""
    is_distance: bool = True  # whether the value is a signed distance (m)
    value_label: str = "signed distance (m)"  # the name of the value on axes of figures
    surface_level: float  # the value whose isosurface is drawn as the scene's surface
    Settings: type = MappingSettings  # the class of its mapping settings

    def __init__(self, bounds: SceneBounds) -> None:
        super().__init__()
        self.bounds = bounds

    def __call__(self, points_world: Points) -> tuple[Colors, Values]:
        """Colour and value as `forward` gives them, at points (m, world frame) in any precision.

        Raises DataError for anything but a tensor of shape (n, 3).
        """
        check_array("points", points_world, ("n", 3), [Shaped], "in m", Tensor)
        return super().__call__(points_world.float())

    @abc.abstractmethod
    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Colour in [0, 1] and the field's value at points (m, world frame, single precision)."""

    @classmethod
    def from_state(cls, state: State, made: dict[str, Any], bounds: SceneBounds) -> "Field":
        """The field of a map file, from its `state_dict` and the record of its `Map`."""
        raise NotImplementedError(f"{cls.__name__} is kept in no map file")

    def diagnostics(self) -> dict[str, float]:
        """Scalars, by name, that are recorded during mapping in addition to the losses."""
        return {}

    @property
    def width(self) -> int:
        """The number of units of the widest layer, on which the number of threads depends.

        A field without layers has the width 0, and is computed by a single thread.
        """
        # A layer's weights have a row for each unit. A scalar, as NeuS's `variance`, is no layer.
        return max((len(weight) for weight in self.parameters() if weight.dim()), default=0)

    @property
    def device(self) -> torch.device:
        """The device of the field's tensors; PyTorch's default device if the field has none."""
        tensors = [*self.parameters(), *self.buffers(), torch.empty(0)]
        return tensors[0].device


class LearnedField(Field):
    """A field that is fitted to posed frames by gradient descent, and can be rendered.

    A subclass is constructed from settings of its class `Network`, the bounds and a generator.
    """

    Network: type = NetworkSettings

    @abc.abstractmethod
    def weights(self, values: RaySamples, rays: Rays, depths: RaySamples) -> Weights:
        """Probabilities that rays end at their samples, or in the sections between two samples.

        `values` are those of the field at ascending z-depths (m) along the rays.
        """

    @abc.abstractmethod
    def mapping_losses(self, draw: Draw, settings: MappingSettings, generator: Generator) -> Losses:
        """Weighted loss terms, by name, of rays that `draw` returns. Their sum is minimised."""

    def prepare(self, sequence: RgbdSequence, frames: Frames) -> None:
        """Prepare for mapping: compute from the mapped frames what the losses need besides batches.

        Fields whose losses need nothing else do nothing here.
        """

    @classmethod
    def from_state(cls, state: State, made: dict[str, Any], bounds: SceneBounds) -> "LearnedField":
        """The field of a map file. Its weights are constants: they need no gradient."""
        field = cls(cls.Network(**made["network"]), bounds, Generator())
        field.load_state_dict(state)
        return field.eval().requires_grad_(False)

    def composite(
        self, colors: RayColors, values: RaySamples, rays: Rays, depths: RaySamples
    ) -> Rendering:
        """Volume rendering from the field's colours and values at ascending z-depths (m).

        If weights are those of sections, the colour and the depth of a section are the means of its
        two samples (our choice; NeuS evaluates the network once more at the mid-point).
        """
        weights = self.weights(values, rays, depths)
        if weights.shape == depths.shape:
            return rendering.composite(weights, colors, depths)
        middle_colors = (colors[:, 1:] + colors[:, :-1]) / 2
        middles = (depths[:, 1:] + depths[:, :-1]) / 2
        return replace(rendering.composite(weights, middle_colors, middles), depths=depths)

    def query_along(self, rays: Rays, depths: RaySamples) -> tuple[RayColors, RaySamples]:
        """Colour and value at z-depths (m) along rays."""
        colors, values = self(rays.points(depths).flatten(0, 1))
        return colors.view(*depths.shape, 3), values.view_as(depths)

    def render(self, rays: Rays, depths: RaySamples) -> Rendering:
        """Volume rendering with samples at ascending z-depths (m)."""
        colors, values = self.query_along(rays, depths)
        return self.composite(colors, values, rays, depths)

    def render_hierarchically(
        self, rays: Rays, n_stratified: int, n_importance: int, generator: Generator | None = None
    ) -> Rendering:
        """Volume rendering with samples in two passes, the second where the first has weight.

        The field is queried once at each sample. Without a generator samples are not random.
        Source: iMAP, Sec. 3.2 (32 and 12 samples).
        """
        with torch.no_grad():  # z-depths of samples are constants, even if a pose is optimised
            far = rays_end(rays, self.bounds)
            coarse = rendering.stratified_samples(NEAR, far, n_stratified, generator)
        colors, values = self.query_along(rays, coarse)
        with torch.no_grad():
            weights = self.weights(values, rays, coarse)
            if weights.shape != coarse.shape:
                # The weights are those of sections: the weight of a sample is the sum of the
                # weights of the two sections beside it.
                weights = nn.functional.pad(weights, (0, 1)) + nn.functional.pad(weights, (1, 0))
            fine = rendering.importance_depths(coarse, weights, n_importance, generator)
        fine_colors, fine_values = self.query_along(rays, fine)
        depths, order = torch.cat([coarse, fine], dim=1).sort()
        all_colors = torch.cat([colors, fine_colors], dim=1).take_along_dim(order[..., None], dim=1)
        all_values = torch.cat([values, fine_values], dim=1).gather(1, order)
        return self.composite(all_colors, all_values, rays, depths)

    @typed
    @usual_modes()
    def render_view(self, camera: Intrinsics, T_world_camera: Pose) -> View:
        """The colour (in [0, 1]) and z-depth (m) images from a camera pose, without randomness."""
        pose = torch.from_numpy(checked_pose(T_world_camera)).float().to(self.device)
        shape = (camera.height, camera.width)
        # The indices of all pixels, row-major.
        rows, columns = torch.ones(shape, device=self.device).nonzero(as_tuple=True)
        directions_world = pixel_directions(camera, columns, rows) @ pose[:3, :3].T
        color, depth = self.render_rays(pose[:3, 3].expand_as(directions_world), directions_world)
        return color.cpu().view(*shape, 3).numpy(), depth.cpu().view(shape).numpy()

    @torch.no_grad()
    def render_rays(self, origins_world: Points, directions_world: Points) -> tuple[Colors, Values]:
        """Colour and z-depth (m) of rays, from two passes whose samples are not random."""
        parts = []
        batches = [each.split(_RAYS_AT_ONCE) for each in (origins_world, directions_world)]
        for origins, directions in zip(*batches, strict=True):
            unused = torch.zeros_like(origins)  # in place of measured colours and depths
            rays = Rays(origins, directions, unused, unused[:, 0])
            parts.append(self.render_hierarchically(rays, _N_STRATIFIED, _N_IMPORTANCE))
        color = torch.cat([part.color.clamp(0, 1) for part in parts])
        return color, torch.cat([part.depth for part in parts])


def rays_end(rays: Rays, bounds: SceneBounds) -> Values:
    """Z-depths (m) at which rays leave the scene.

    They are at least 2 x `NEAR`, so that samples, which begin at `NEAR`, ascend on every ray.
    """
    return bounds.far_bound(rays.origins_world, rays.directions_world).clamp_min(2 * NEAR)


def measured_mean(error: Float[Tensor, "*some"], is_measured: Float[Tensor, "*some"]) -> Scalar:
    """The mean of the errors whose mask `is_measured` is 1; 0 if the mask is 0 everywhere."""
    return (error * is_measured).sum() / is_measured.sum().clamp_min(1)


def rendered_losses(
    seen: Rendering, rays: Rays, lambda_color: float, lambda_depth: float, over_std: bool = False
) -> Losses:
    """Weighted L1 losses of the depth (m) and colour that rays see, for mapping and tracking.

    Rays without a measured depth count in neither loss, so that both are of the same pixels. With
    `over_std` each ray's depth error is divided by the standard deviation of its rendered depth, as
    in iMAP (Sec. 3.3): mean(|D - D_rendered| / sqrt(variance)). This deviation is at least
    `MIN_STD` (m). No gradient flows through it, as in NICE-SLAM, since it would reward blurred
    surfaces.
    """
    is_measured = (rays.depth > 0).float()
    depth_error = (seen.depth - rays.depth).abs()
    if over_std:
        depth_error = depth_error / seen.depth_variance.detach().sqrt().clamp_min(MIN_STD)
    color_error = (seen.color - rays.color).abs().mean(dim=1)
    return {
        "depth": lambda_depth * measured_mean(depth_error, is_measured),
        "color": lambda_color * measured_mean(color_error, is_measured),
    }
