"""iMAP with VR: the paper's baseline, which renders pixels and compares images."""

from jaxtyping import Float, Int
from torch import Generator, Tensor

from nbtrack.core.camera import pixel_directions
from nbtrack.core.config import TrackingConfig
from nbtrack.data.pixels import Rays
from nbtrack.fields import LearnedField
from nbtrack.fields.imap import rendering_losses
from nbtrack.fields.rendering import Rendering
from nbtrack.fields.sampling import render_in_two_passes, two_pass_depths
from nbtrack.tracking.trackers.base import AdamTracker, register_tracker


@register_tracker
class VolumeRenderingTracker(AdamTracker):
    """Matches rendered to observed colour and depth. Paper, Sec. II-B.1; iMAP, Sec. 3.3."""

    name = "vr"
    label = "iMAP with VR"
    short_label = "VR"
    field_name = "imap"
    paper_steps = "vr"
    table_order = 0
    renders = True

    @classmethod
    def evaluations_per_pixel(cls, config: TrackingConfig) -> int:
        """Both passes: the second asks again for the samples of the first."""
        return 2 * config.n_stratified + config.n_importance

    def loss(
        self,
        T_world_camera: Float[Tensor, "4 4"],
        rows: Int[Tensor, "n"],
        columns: Int[Tensor, "n"],
    ) -> Float[Tensor, ""]:
        """iMAP's loss of rendered pixels; gradients reach the pose through every sample."""
        frames = self.frame_number.expand_as(rows)
        color, depth = self.sampler.measurements(frames, rows, columns)
        directions_camera = pixel_directions(self.sampler.intrinsics, columns, rows)
        directions_world = directions_camera @ T_world_camera[:3, :3].T
        origins_world = T_world_camera[:3, 3].expand_as(directions_world)
        rays = Rays(origins_world, directions_world, color, depth)
        render = render_in_two_passes if self.config.engine == "fast" else _render_plainly
        rendering = render(
            self.field, rays, self.config.n_stratified, self.config.n_importance, self.generator
        )
        terms = rendering_losses(rendering, rays, self.config.lambda_color)
        return terms["depth"] + terms["color"]


def _render_plainly(
    field: LearnedField,
    rays: Rays,
    n_stratified: int,
    n_importance: int,
    generator: Generator,
) -> Rendering:
    """iMAP's two passes as they are described: depths first, then a rendering at all of them."""
    return field.render(rays, two_pass_depths(field, rays, n_stratified, n_importance, generator))
