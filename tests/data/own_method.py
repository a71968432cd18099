"""A field whose distances fade, and a tracker that only looks at distances."""

from dataclasses import dataclass

import nbtrack
from nbtrack.core.geometry import transform_points
from nbtrack.fields import FIELDS, NeuSField, NeusMapping
from nbtrack.tracking import TRACKERS, AdamTracker


@dataclass(frozen=True)
class FadingMapping(NeusMapping):
    decay: float = 0.5


class FadingField(NeuSField):
    name, label, Settings = "fading", "Fading NeuS", FadingMapping

    def mapping_losses(self, batch, settings, generator):
        losses = super().mapping_losses(batch, settings, generator)
        return {name: settings.decay * loss for name, loss in losses.items()}


class DistanceTracker(AdamTracker):
    name = "distance"

    def loss(self, T_world_camera, directions_camera, color, depth):
        points_camera = directions_camera * depth[:, None]
        return self.field(transform_points(T_world_camera, points_camera))[1].square().mean()


FIELDS["fading"] = FadingField
TRACKERS["distance"] = DistanceTracker
cells = ("correction.fading=0.3",)
nbtrack.METHODS["mine"] = nbtrack.Method("Mine", "fading", "distance")
nbtrack.METHODS |= {"fine": nbtrack.Method("Mine corrected", "fading", "lm", cells)}
