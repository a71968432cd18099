"""Formulas by laws that must hold, or against values worked by hand in another way."""

import numpy as np
import pytest
import torch
from box_room import Formula, poses_at, sequence_of

from nbtrack.beyond.correction import corrected
from nbtrack.beyond.neus_plus import NeuSPlusField
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.data.pixels import Rays
from nbtrack.fields import NetworkSettings, NeusMapping
from nbtrack.fields.base import NEAR
from nbtrack.fields.neus import NeuSField
from nbtrack.recordings.reading import FAR, far_limit

BOX = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 3.0))


def rays_ahead(n: int, depth: float) -> Rays:
    """Rays from the origin along z."""
    ahead = torch.tensor([0.0, 0.0, 1.0]).expand(n, 3)
    return Rays(torch.zeros(n, 3), ahead, torch.full((n, 3), 0.5), torch.full((n,), depth))


class Slope(NeuSField):
    """A value that rises by 3 per metre along x."""

    def forward(self, points_world: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.sigmoid(points_world), 3 * points_world[:, 0]


@pytest.mark.parametrize("kind", [NeuSField, NeuSPlusField])
def test_the_eikonal_term_by_hand(kind: type) -> None:
    """Catches a norm that is not squared, or not compared with one: with a slope of 3 the term is
    lambda (3 - 1)^2, and 0 where lambda is."""
    field = type("Steep", (Slope, kind), {})(NetworkSettings(16), BOX, torch.Generator())
    for weight in (0.5, 2.0):
        settings = NeusMapping(lambda_eikonal=weight)
        term = field._eikonal(torch.rand(5, 4, 3), settings, torch.Generator())
        assert term.item() == pytest.approx(4 * weight, rel=1e-5)


@pytest.mark.parametrize("wall", [1.0, 1.4, 2.2])
def test_samples_of_the_second_pass_lie_around_their_section(wall: float) -> None:
    """Catches weights of sections that are given to one of their ends alone: of eight even samples
    those beside the wall have the weight of the section between them, so that the new samples lie
    evenly around its middle."""
    field = Formula(lambda points: 50 * (wall - points[:, 2]), BOX)
    depths = field.hierarchical_depths(rays_ahead(1, 0.0), 8, 16)[0]
    step = (3.0 - NEAR) / 8
    even = NEAR + step * (torch.arange(8) + 0.5)
    added = depths[(depths[:, None] - even).abs().amin(dim=1) > 1e-5]
    before = even[even < wall].max()
    assert len(added) == 16
    assert added.mean().item() == pytest.approx((before + step / 2).item(), abs=0.02)
    assert ((added - before - step / 2).abs() < 1.01 * step).all()


def test_near_measurements_count_more(monkeypatch) -> None:
    """Catches weights of depths that are left out, inverted or not squared: of a wall at 2 m, seen
    from 1 m as it is and from 2 m as 6 mm farther, the near view has four times the points on it,
    and each counts four times as much: the zero level moves by a seventeenth of the 6 mm."""
    monkeypatch.setattr("nbtrack.beyond.correction._N_POINTS", 60_000)
    camera, shape = Intrinsics.from_focal(64, 48, 48.0), (48, 64)
    poses = poses_at([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    depths_mm = np.stack([np.full(shape, 1000.0), np.full(shape, 2006.0)])
    sequence = sequence_of(depths_mm, camera, poses=poses)
    exact = Formula(lambda points: 2.0 - points[:, 2], BOX)
    field = corrected(exact, sequence, np.arange(2), 0.1)
    seen_by_both = torch.tensor([[x, y, 2.0] for x in (-0.3, 0.0, 0.3) for y in (-0.2, 0.2)])
    assert field(seen_by_both)[1].mean().item() == pytest.approx(0.006 / 17, rel=0.2)


def test_where_depths_become_outliers() -> None:
    """Catches another quantile: of a hundred depths the ninetieth decides."""
    assert far_limit(np.array([1.0] * 85 + [3.0] * 10 + [50.0] * 5)) == pytest.approx(3 * FAR)
    assert far_limit(np.array([])) == np.inf
