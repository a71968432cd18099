"""VR, VR by colour alone, and SDF in five fields; and a level set of density in place of SDF.

    python benchmarks/other_fields.py [SEEDS]

Rows are added to paper_tables/other_fields/table_1_cells.csv as they are finished. Rows that are
there are not made again, whatever has changed since: remove the file to begin anew. The first seed
takes 90 minutes on one core. Each further one has NeuS and VolSDF alone, and takes 15 minutes.

Then rows of the tracker `level` are added to density.csv: in the rooms of `smoke`, along whole
paths, from the previous pose, with the steps of SDF.
"""

import sys
from collections.abc import Iterator
from functools import partial
from itertools import product

from evidence import Chunk, add_rows, track
from motions import HAND_HELD

from nbtrack import METHODS, Method, load_preset, open_scenes
from nbtrack.core.arrays import Colors, Points, Scalar, Transform, Values
from nbtrack.core.geometry import transform_points
from nbtrack.fields.imap import IMapField
from nbtrack.machinery.files import tables_folder
from nbtrack.tracking import TRACKERS
from nbtrack.tracking.paper import SdfTracker

ROWS = (
    "vr", "color", "vr_neus", "color_neus", "sdf", "vr_volsdf", "color_volsdf", "sdf_volsdf",
    "vr_plus", "color_plus", "sdf_plus", "vr_occupancy", "color_occupancy",
)  # fmt: skip
FURTHER = ("vr_neus", "sdf", "vr_volsdf", "sdf_volsdf")  # rows of the seeds after the first
RATES_HZ = (10.0, 2.0)


class LevelTracker(SdfTracker):
    """Eq. 2 in a density field, for which the paper says that it does not apply.

    The distance is replaced by ln(density / level), with the level at which surfaces are drawn.
    """

    name = "level"

    @classmethod
    def works_in(cls, field: type) -> bool:
        """Whether a field is a density."""
        return issubclass(field, IMapField)

    def loss(
        self, T_world_camera: Transform, directions_camera: Points, color: Colors, depth: Values
    ) -> Scalar:
        """The mean of |ln(density / level)| at the observed points, without colour."""
        points_world = transform_points(T_world_camera, directions_camera * depth[:, None])
        _, density = self.field(points_world)
        return (density.clamp(min=1e-3) / self.field.surface_level).log().abs().mean()


TRACKERS["level"] = LevelTracker
LEVEL = Method("iMAP with a level of density", "imap", "level")


def track_rows(seeds: int) -> Iterator[Chunk]:
    """Chunks of rows of the five fields: one for each seed, room and method, on the whole path."""
    preset = load_preset("smoke", settings=HAND_HELD)
    for seed, scene, name in product(range(seeds), open_scenes(preset), ROWS):
        if seed and name not in FURTHER:
            continue
        place = {"scene": scene.name, "seed": seed, "method": METHODS[name].label}
        how = {"rates_hz": RATES_HZ, "frames": ":", "seeds": [seed]}
        yield place, partial(track, [scene], [name], preset, 1, **how)


def density_rows(seeds: int) -> Iterator[Chunk]:
    """Chunks of rows of the tracker `level`: one for each seed and room."""
    preset = load_preset("smoke")
    for seed, scene in product(range(seeds), open_scenes(preset)):
        place, how = {"scene": scene.name, "seed": seed}, {"frames": ":", "seeds": [seed]}
        yield place, partial(track, [scene], [LEVEL], preset, 1, **how)


def main(seeds: int) -> None:
    """Add the missing rows of both files."""
    folder = tables_folder() / "other_fields"
    add_rows(folder / "table_1_cells.csv", track_rows(seeds))
    add_rows(folder / "density.csv", density_rows(seeds))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
