"""A field on grids of features: what it answers, how it learns, and what a file keeps of it."""

from pathlib import Path

import pytest
import torch
from test_neus_plus import slanted_wall
from torch import Generator

from nbtrack.beyond.feature_grid import FeatureGrid, GridNetwork, GridPlusMapping
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.errors import ConfigError
from nbtrack.experiments.presets import load_preset
from nbtrack.mapping.files import read_map, write_map
from nbtrack.mapping.fit import map_sequence

BOX = SceneBounds((-1.0, -0.5, 0.0), (1.0, 0.5, 3.0))


def test_levels_by_hand() -> None:
    """Catches a level that is left out or read in another's cells: at a vertex of the coarsest one
    the features are its own, and those of the vertices of the finer ones that lie there."""
    grid = FeatureGrid(GridNetwork(finest=0.1, levels=3), BOX, Generator().manual_seed(0))
    vertex = torch.tensor([[-1.0 + 0.4, -0.5 + 0.8, 1.2]])  # number 1, 2, 3 of the coarsest
    expected = [
        volume[:, k, 2 * k, 3 * k] for volume, k in zip(grid.volumes, (4, 2, 1), strict=True)
    ]
    normalized = (vertex[0] - torch.tensor([-1.0, -0.5, 0.0])) / BOX.metres_per_unit - 1
    with torch.no_grad():
        hidden = grid.layer(torch.cat([*expected, normalized]))
        torch.testing.assert_close(grid.features(vertex)[0], torch.nn.functional.silu(hidden))


def test_it_learns_and_is_kept(tmp_path: Path) -> None:
    """Catches features that learn nothing, and a file that does not keep them."""
    depth = torch.linspace(0.5, 2.1, 17)
    points = torch.stack([torch.zeros(17), torch.zeros(17), depth], dim=-1)
    few = {"n_rays": 32, "n_surface_points": 64}
    errors = []
    for iterations in (1, 40):
        settings = GridPlusMapping(iterations, **few)
        made = map_sequence("grid_plus", slanted_wall(4), GridNetwork(), settings)
        errors.append((made.field(points)[1] - (2 - depth) / 2**0.5).abs().mean())
    assert errors[1] < 0.2 * errors[0]
    write_map(tmp_path / "map.safetensors", made)
    assert torch.equal(read_map(tmp_path).field(points)[1], made.field(points)[1])


def test_the_eikonal_term_is_refused() -> None:
    """Catches a setting that ends in the middle of mapping: grids have no second derivative."""
    with pytest.raises(ConfigError, match="lambda_eikonal"):
        load_preset(settings=["mapping.grid_plus.lambda_eikonal=0.1"])
