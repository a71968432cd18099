"""The interface of fields to mapping and tracking."""

import abc
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
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
from nbtrack.machinery.inputs import check_points, checked_pose
from nbtrack.machinery.settings import MANY, limited

# Minimum standard deviation (m) that a depth error is divided by: a perfectly sharp ray would
# otherwise outweigh all others (our choice; depth noise is of this size).
MIN_STD = 0.02
NEAR = 0.05  # m, z-depth before which nothing is looked for: closer than any depth camera measures

# Samples a ray in pictures: twice those of mapping, and in fixed places, so that an image shows the
# field and not the luck of the draw.
_N_STRATIFIED = 48
_N_IMPORTANCE = 24
_RAYS_AT_ONCE = 4096  # of a picture, so that all its samples need not be in memory

Losses = dict[str, Scalar]
State = dict[str, Tensor]
View = tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width"]]
Draw = Callable[..., Rays]  # `PixelSampler.draw` of n_rays and tangent_planes; depth 0: unmeasured


@dataclass(frozen=True)
class MappingSettings:
    """Fitting a field to posed frames. The paper gives none of these figures."""

    iterations: int = 20_000
    n_rays: int = limited(1024, 1, 65536)  # a batch, drawn over all mapping frames
    # Samples a ray, spread evenly (iMAP); the rendered depth of a single one has no gradient.
    n_stratified: int = limited(32, 2, 1024)
    # Samples a ray at the surface: iMAP's second pass, or around the measured depth (NeuS).
    n_surface: int = limited(12, 0, 1024)
    learning_rate: float = 1e-3  # Adam's, at the start; falls to a twentieth along a cosine (NeuS)
    lambda_color: float = 5.0  # iMAP's, whose depth errors are relative to their std
    holdout_every: int = limited(10, 0, MANY)  # every n-th frame is only scored
    tf32: bool = False  # matrix products in TF32, on NVIDIA's GPUs


class Field(nn.Module, abc.ABC):
    """A scene as a function of position: colour, and a value that says where surfaces are."""

    name: str  # on the command line and in file names
    label: str  # in tables and figures
    form: str = ""  # what was made of a mapped field, by its name in `FORMS`; empty: nothing
    is_distance: bool = True  # whether its value is a signed distance (m)
    value_label: str = "signed distance (m)"  # on axes
    surface_level: float  # the value whose isosurface is drawn as the scene's surface
    Settings: type = MappingSettings  # of mapping

    def __init__(self, bounds: SceneBounds) -> None:
        super().__init__()
        self.bounds = bounds

    def __call__(self, points_world: Points) -> tuple[Colors, Values]:
        """`forward` at points in any precision. DataError if they are no tensor of points."""
        check_points(points_world)
        return super().__call__(points_world.float())

    @abc.abstractmethod
    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Colour in [0, 1] and the field's value at points (m, world frame, single precision)."""

    @classmethod
    def from_state(cls, state: State, made: dict[str, Any], bounds: SceneBounds) -> "Field":
        """The field of a map file: what `state` gave, and how it was made (a `Map`'s record)."""
        raise NotImplementedError(f"{cls.__name__} is kept in no map file")

    def state(self) -> State:
        """All that was learnt, by name, for a map file."""
        return self.state_dict()

    def diagnostics(self) -> dict[str, float]:
        """Scalars worth a curve over training, beside the losses."""
        return {}

    @property
    def width(self) -> int:
        """Units of its widest layer, by which threads are chosen; 0 where one thread is best."""
        return max((len(weight) for weight in self.parameters() if weight.dim()), default=0)

    @property
    def device(self) -> torch.device:
        """Where its tensors lie."""
        return next(itertools.chain(self.parameters(), self.buffers()), torch.empty(0)).device


class LearnedField(Field):
    """A field that is fitted to posed frames by gradient descent, and can be rendered.

    It is made of settings of its `Network`, the bounds and a generator.
    """

    Network: type = NetworkSettings

    @abc.abstractmethod
    def weights(self, values: RaySamples, rays: Rays, depths: RaySamples) -> Weights:
        """Probabilities that rays end at samples at ascending z-depths (m), or between two."""

    @abc.abstractmethod
    def mapping_losses(self, draw: Draw, settings: MappingSettings, generator: Generator) -> Losses:
        """Weighted loss terms of random rays, by name; their sum is minimised."""

    def prepare(self, sequence: RgbdSequence, frames: Frames) -> None:
        """Take from the frames to be mapped what the losses need besides the rays of a batch."""

    @classmethod
    def from_state(cls, state: State, made: dict[str, Any], bounds: SceneBounds) -> "LearnedField":
        """A network with these weights, which learns no more."""
        field = cls(cls.Network(**made["network"]), bounds, Generator())
        field.load_state_dict(state)
        return field.eval().requires_grad_(False)

    def composite(
        self, colors: RayColors, values: RaySamples, rays: Rays, depths: RaySamples
    ) -> Rendering:
        """Volume rendering from what the field answered at ascending z-depths (m).

        A section between two samples has the mean of its ends. That is its mid-point (our choice;
        NeuS evaluates the network there once more).
        """
        weights = self.weights(values, rays, depths)
        if weights.shape != depths.shape:  # of sections
            colors = (colors[:, 1:] + colors[:, :-1]) / 2
            depths = (depths[:, 1:] + depths[:, :-1]) / 2
        return rendering.composite(weights, colors, depths)

    def query_along(self, rays: Rays, depths: RaySamples) -> tuple[RayColors, RaySamples]:
        """Colour and value at z-depths (m) along rays."""
        colors, values = self(rays.points(depths).flatten(0, 1))
        return colors.view(*depths.shape, 3), values.view_as(depths)

    def render(self, rays: Rays, depths: RaySamples) -> Rendering:
        """Volume rendering with samples at ascending z-depths (m)."""
        colors, values = self.query_along(rays, depths)
        return self.composite(colors, values, rays, depths)

    @torch.no_grad()
    def hierarchical_depths(
        self, rays: Rays, n_stratified: int, n_importance: int, generator: Generator | None = None
    ) -> RaySamples:
        """Ascending sample depths (m): spread over the scene, and more where those found something.

        Without a generator nothing is random. Source: iMAP, Sec. 3.2 (32 and 12 samples).
        """
        coarse, _, _, fine = self._two_passes(rays, n_stratified, n_importance, generator)
        return torch.cat([coarse, fine], dim=1).sort(dim=1).values

    def render_hierarchically(
        self, rays: Rays, n_stratified: int, n_importance: int, generator: Generator | None = None
    ) -> Rendering:
        """What `render` gives at `hierarchical_depths`, with every sample asked for once."""
        coarse, colors, values, fine = self._two_passes(rays, n_stratified, n_importance, generator)
        fine_colors, fine_values = self.query_along(rays, fine)
        depths, order = torch.cat([coarse, fine], dim=1).sort(dim=1)
        all_colors = torch.cat([colors, fine_colors], dim=1)
        all_colors = all_colors.gather(1, order[..., None].expand_as(all_colors))
        all_values = torch.cat([values, fine_values], dim=1).gather(1, order)
        return self.composite(all_colors, all_values, rays, depths)

    @usual_modes()
    def render_view(self, camera: Intrinsics, T_world_camera: Pose) -> View:
        """Colour in [0, 1] and z-depth (m) from a camera pose. Nothing in it is random."""
        pose = torch.from_numpy(checked_pose(T_world_camera)).float().to(self.device)
        shape = (camera.height, camera.width)
        # The indices of all pixels, row by row.
        rows, columns = torch.ones(shape, device=self.device).nonzero(as_tuple=True)
        directions_world = pixel_directions(camera, columns, rows) @ pose[:3, :3].T
        color, depth = self.render_rays(pose[:3, 3].expand_as(directions_world), directions_world)
        return color.cpu().view(*shape, 3).numpy(), depth.cpu().view(shape).numpy()

    @torch.no_grad()
    def render_rays(self, origins_world: Points, directions_world: Points) -> tuple[Colors, Values]:
        """Colour and z-depth (m) of rays, by two passes with fixed samples."""
        parts = []
        some_origins = origins_world.split(_RAYS_AT_ONCE)
        some_directions = directions_world.split(_RAYS_AT_ONCE)
        for origins, directions in zip(some_origins, some_directions, strict=True):
            unknown = torch.zeros_like(origins)  # observed colours and depths, which none uses
            rays = Rays(origins, directions, unknown, unknown[:, 0])
            parts.append(self.render_hierarchically(rays, _N_STRATIFIED, _N_IMPORTANCE))
        color = torch.cat([part.color.clamp(0, 1) for part in parts])
        return color, torch.cat([part.depth for part in parts])

    def _two_passes(
        self, rays: Rays, n_stratified: int, n_importance: int, generator: Generator | None
    ) -> tuple[RaySamples, RayColors, RaySamples, RaySamples]:
        """Z-depths (m) of the first pass, colours and values there, and z-depths of the second."""
        with torch.no_grad():  # z-depths of samples are constants, also where a pose is optimised
            far = rays_end(rays, self.bounds)
            coarse = rendering.stratified_depths(NEAR, far, n_stratified, generator)
        colors, values = self.query_along(rays, coarse)
        with torch.no_grad():
            weights = self.weights(values, rays, coarse)
            if weights.shape != coarse.shape:  # of sections: a sample gets those on both sides
                weights = nn.functional.pad(weights, (0, 1)) + nn.functional.pad(weights, (1, 0))
            fine = rendering.importance_depths(coarse, weights, n_importance, generator)
        return coarse, colors, values, fine


def rays_end(rays: Rays, bounds: SceneBounds) -> Values:
    """Z-depth (m) at which rays leave the scene; at least twice `NEAR`, where samples begin."""
    return bounds.far_bound(rays.origins_world, rays.directions_world).clamp_min(2 * NEAR)


def measured_mean(error: Float[Tensor, "*some"], measured: Float[Tensor, "*some"]) -> Scalar:
    """Mean error where there is a measurement (a mask of 0 and 1); 0 if there is none."""
    return (error * measured).sum() / measured.sum().clamp_min(1)


def rendered_losses(
    seen: Rendering, rays: Rays, lambda_color: float, lambda_depth: float, over_std: bool = False
) -> Losses:
    """Weighted L1 errors of rendered depth (m) and colour, for mapping and tracking.

    Rays without a depth measurement take part in neither term. With `over_std` a depth error is
    divided by the standard deviation of the ray's own rendered depth, as iMAP does:
    mean(|D - D_rendered| / sqrt(variance)). That std is detached, as in NICE-SLAM, for its gradient
    would reward blurred surfaces.
    Source: iMAP, Sec. 3.3.
    """
    measured = (rays.depth > 0).float()
    depth_error = (seen.depth - rays.depth).abs()
    if over_std:
        depth_error = depth_error / seen.depth_variance.detach().sqrt().clamp_min(MIN_STD)
    color_error = (seen.color - rays.color).abs().mean(dim=1)
    return {
        "depth": lambda_depth * measured_mean(depth_error, measured),
        "color": lambda_color * measured_mean(color_error, measured),
    }
