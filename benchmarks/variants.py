"""What the experiments of `evidence.py` change where no setting does: trackers, fields, depth.

Importing this module makes them known by name; `with_variants` gives them the settings of what they
were made from.
"""

from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import inf

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, silu
from torch.optim.lr_scheduler import CosineAnnealingLR

from nbtrack.beyond.points import depth_behind
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.settings import flat
from nbtrack.data.sequence import RgbdSequence
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.scenes import Scene
from nbtrack.fields import FIELDS, Field, IMapField, NetworkSettings
from nbtrack.recordings.recording import Recording, open_recording
from nbtrack.synthetic import Room
from nbtrack.tracking import TRACKERS, AdamTracker, SdfTracker, VrTracker

FALLING_STEPS = 100


class _Kept(AdamTracker):
    """Adam's moments go on from frame to frame."""

    remembers = ("moments",)
    moments = None

    def begin(self, frame, T_starts) -> None:
        super().begin(frame, T_starts)
        if self.moments is not None:
            self.optimizer.load_state_dict(self.moments)

    def step(self) -> Tensor:
        loss = super().step()
        self.moments = self.optimizer.state_dict()
        return loss


class _Best(AdamTracker):
    """The iterate with the lowest loss counts, each on the pixels of its own step (NICE-SLAM)."""

    def begin(self, frame, T_starts) -> None:
        super().begin(frame, T_starts)
        self.least = inf

    def step(self) -> Tensor:
        before = self.T_world_camera.detach()
        loss = super().step()
        if loss < self.least:
            self.least, self.best = float(loss), before.double().numpy()
        return loss

    def _search(self, frame, T_starts, budget):
        found = super()._search(frame, T_starts, budget)
        return replace(found, T_world_camera=self.best)


class _Falling(AdamTracker):
    """Learning rates fall to zero along a cosine: large ones reach far, and still converge."""

    def begin(self, frame, T_starts) -> None:
        super().begin(frame, T_starts)
        self.schedule = CosineAnnealingLR(self.optimizer, FALLING_STEPS)

    def step(self) -> Tensor:
        loss = super().step()
        self.schedule.step()
        return loss


class VrKept(_Kept, VrTracker):
    """VR with Adam's memory."""

    name = "vr_kept"


class SdfKept(_Kept, SdfTracker):
    """SDF with Adam's memory."""

    name = "sdf_kept"


class VrBest(_Best, VrTracker):
    """VR, its best iterate."""

    name = "vr_best"


class SdfBest(_Best, SdfTracker):
    """SDF, its best iterate."""

    name = "sdf_best"


class VrFalling(_Falling, VrTracker):
    """VR with falling rates."""

    name = "vr_falling"


class SdfFalling(_Falling, SdfTracker):
    """SDF with falling rates."""

    name = "sdf_falling"


class SmoothNetwork(NetworkSettings):
    """A class of its own, so that presets keep it apart from the network of NeuS."""


class SmoothImap(IMapField):
    """iMAP with the activation of NeuS."""

    name, Network = "imap_silu", SmoothNetwork

    def __init__(self, *args) -> None:
        super().__init__(*args)
        self.mlp.activation = silu


_TRACKERS = (VrKept, SdfKept, VrBest, SdfBest, VrFalling, SdfFalling)
TRACKERS.update({kind.name: kind for kind in _TRACKERS})
FIELDS[SmoothImap.name] = SmoothImap


def with_variants(preset: Preset) -> Preset:
    """The preset, with settings for the variants: those of what each was made from."""
    trackers = {kind.name: preset.tracking_of(kind.name.split("_")[0]) for kind in _TRACKERS}
    mapping, network = preset.mapping_of("imap"), preset.network_of("imap")
    settings = {"tracking": trackers, "mapping": {"imap_silu": mapping}}
    return preset.with_values(flat(settings | {"network": {"imap_silu": network}}))


@dataclass(frozen=True)
class OtherDepth(Scene):
    """A synthetic room read with another of its depths: exact, or as the sensor gave it."""

    depth_folder: str = "depth"

    @cached_property
    def recording(self) -> Recording:
        """With the depth of that folder."""
        return open_recording(self.folder, self.format, self.depth_folder)


@dataclass(frozen=True)
class Backwards(Scene):
    """A recording whose last frame comes first."""

    @cached_property
    def fingerprint(self) -> str:
        """Another than that of the recording."""
        return f"{Scene(self.name, self.folder).fingerprint} backwards"

    def read(self, frames: str = ":", **options) -> RgbdSequence:
        """Its frames, with their times in the order of time."""
        forwards = super().read(frames, **options)
        return replace(forwards.select(slice(None, None, -1)), times=forwards.times)


class _Uncoloured(Field):
    """A signed distance (m) alone: grey everywhere."""

    surface_level = 0.0

    def __init__(self, bounds: SceneBounds) -> None:
        super().__init__(bounds)

    def forward(self, points_world: Tensor) -> tuple[Tensor, Tensor]:
        return torch.full_like(points_world, 0.5), self.value(points_world)


class ExactDistance(_Uncoloured):
    """The room's own distance."""

    name, label = "exact", "exact distance"

    def __init__(self, bounds: SceneBounds, room: Room) -> None:
        super().__init__(bounds)
        self.room = room

    def value(self, points_world: Tensor) -> Tensor:
        """Signed distance (m)."""
        return torch.from_numpy(self.room.sdf(points_world.double().numpy())).to(points_world)


class FusedDistance(_Uncoloured):
    """A truncated distance on voxels, fused from depth images as KinectFusion does.

    At a voxel the mean over the frames of how far it lies in front of the depth measured in its
    direction, at most `truncation`; frames that see it farther behind do not count.
    """

    name, label = "fused", "fused voxels"

    def __init__(
        self, sequence: RgbdSequence, frames, bounds: SceneBounds, voxel=0.05, truncation=0.15
    ) -> None:
        super().__init__(bounds)
        axes = [
            torch.arange(low, high + voxel, voxel)
            for low, high in zip(bounds.minimum, bounds.maximum, strict=True)
        ]
        corners = torch.cartesian_prod(*axes)
        total, count = torch.zeros(2, len(corners))
        for index in frames.tolist():
            in_front = -depth_behind(sequence[index], corners)
            seen = in_front > -truncation
            total[seen] += in_front[seen].clamp(max=truncation)
            count += seen
        value = torch.where(count > 0, total / count.clamp_min(1), truncation)
        self.values = value.view(*map(len, axes))[None, None]
        self.low = corners[0]
        self.extent = corners[-1] - corners[0]

    def value(self, points_world: Tensor) -> Tensor:
        """Signed distance (m)."""
        # grid_sample takes x, y, z of a volume indexed z, y, x, from -1 to 1.
        places = (2 * (points_world - self.low) / self.extent - 1).flip(-1)
        sample = partial(grid_sample, padding_mode="border", align_corners=True)
        return sample(self.values, places[None, None, None])[0, 0, 0, 0]
