"""NeuS with SDF: the paper's own tracker, which asks a field for distances, without rendering."""

from jaxtyping import Float, Int
from torch import Tensor

from nbtrack.core.camera import backproject
from nbtrack.core.geometry import transform_points
from nbtrack.tracking.trackers.base import AdamTracker, register_tracker


@register_tracker
class SdfTracker(AdamTracker):
    """Pulls observed points onto the zero level of the signed distance. Paper, Sec. II-B.2."""

    name = "sdf"
    label = "NeuS with SDF"
    short_label = "SDF"
    field_name = "neus"
    paper_steps = "sdf"
    table_order = 1

    def loss(
        self,
        T_world_camera: Float[Tensor, "4 4"],
        rows: Int[Tensor, "n"],
        columns: Int[Tensor, "n"],
    ) -> Float[Tensor, ""]:
        """Paper, Eq. 2, for the pixels' back-projected points."""
        frames = self.frame_number.expand_as(rows)
        color, depth = self.sampler.measurements(frames, rows, columns)
        points_camera = backproject(self.sampler.intrinsics, columns, rows, depth)
        field_color, field_sdf = self.field(transform_points(T_world_camera, points_camera))
        return sdf_loss(
            field_sdf, field_color, color, self.config.lambda_sdf, self.config.lambda_color
        )


def sdf_loss(
    field_sdf: Float[Tensor, "n"],
    field_color: Float[Tensor, "n 3"],
    color: Float[Tensor, "n 3"],
    lambda_sdf: float,
    lambda_color: float,
) -> Float[Tensor, ""]:
    """lambda_sdf mean|d| + lambda_color mean|c - c_observed|, the latter over the 3n channels.

    Args:
        field_sdf: signed distance (m) that the field gives at the observed points.
        field_color, color: the field's and the observed colour there, in [0, 1].

    Source: paper, Eq. 2.

    >>> import torch
    >>> zeros = torch.zeros(2, 3)
    >>> sdf_loss(torch.tensor([0.1, -0.3]), zeros, zeros + 0.5, 1.0, 0.1).item()
    0.25
    """
    return lambda_sdf * field_sdf.abs().mean() + lambda_color * (field_color - color).abs().mean()
