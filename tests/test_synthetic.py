"""The synthetic rooms: exact geometry, exact depth, human motion, a believable sensor."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from nbtrack.core.errors import ConfigError, DataError, MissingError
from nbtrack.data.sequence import read_sequence
from nbtrack.experiments.scenes import DATASET_SCENES
from nbtrack.synthetic import (
    REPORTED_ROOMS,
    ROOMS,
    add_kinect_noise,
    build_room,
    filter_depth,
    handheld_trajectory,
    make_room,
    motion_statistics,
    render_frame,
    room_frames,
    room_intrinsics,
    room_of,
    true_surface_points,
)
from nbtrack.synthetic.fittings import banister, staircase
from nbtrack.synthetic.materials import Patchwork, Plain, Split
from nbtrack.synthetic.motion import CROSSING_FRAMES
from nbtrack.synthetic.primitives import Box, Cylinder, Solid, Sphere
from nbtrack.synthetic.shell import RoomShell

SOLIDS = {
    "box": Box((0.1, -0.2, 0.3), (0.8, 0.5, 1.1)),
    "turned box": Box((0.1, -0.2, 0.3), (0.8, 0.5, 1.1), 0.6),
    "sphere": Sphere((-0.1, 0.2, 0.1), 0.5),
    "upright cylinder": Cylinder((0.2, -0.5, 0.1), (0.2, 0.4, 0.1), 0.3),
    "leaning rod": Cylinder((-0.4, -0.5, 0.0), (0.4, 0.5, 0.3), 0.12),
    "shell": RoomShell((-0.7, -0.5, -0.6), (0.8, 0.6, 0.5)),
}
FOCAL = 554.2562584220407  # 640 / (2 tan 30°)


@pytest.fixture(params=list(SOLIDS))
def solid(request: pytest.FixtureRequest) -> Solid:
    return SOLIDS[request.param]


@pytest.fixture(params=list(ROOMS))
def room_name(request: pytest.FixtureRequest) -> str:
    return request.param


def numerical_gradient(sdf, points, step=1e-6):
    """Central differences of a distance function."""
    offsets = step * np.eye(3)
    return np.stack([sdf(points + o) - sdf(points - o) for o in offsets], axis=1) / (2 * step)


def free_points(room, n, rng):
    points = rng.uniform(*room.bounds, size=(4 * n, 3))
    return points[room.sdf(points) > 1e-3][:n]


def test_solid_sdf_is_the_distance_to_its_surface(solid):
    """Catches a distance that is only a bound, a wrong sign, or samples off the surface."""
    rng = np.random.default_rng(0)
    surface = solid.sample_surface(60_000, rng)
    assert np.abs(solid.sdf(surface)).max() < 1e-12
    points = rng.uniform(-1.2, 1.2, (2000, 3))
    nearest, _ = cKDTree(surface).query(points)
    excess = nearest - np.abs(solid.sdf(points))
    assert excess.min() > -1e-9
    assert excess.max() < 0.03


def test_sign_is_positive_in_free_space(solid):
    """Catches a solid turned inside out: its own center is matter, except in a shell."""
    inside = solid.sdf(solid.bounding_sphere()[0][None])[0]
    far = solid.sdf(np.array([[5.0, 5.0, 5.0]]))[0]
    expected = (1, -1) if isinstance(solid, RoomShell) else (-1, 1)
    assert (np.sign(inside), np.sign(far)) == expected


def test_values_by_hand():
    """Catches a swapped half and full size, or a yaw of the wrong sense."""
    box = Box((0.0, 0.0, 0.0), (2.0, 2.0, 4.0))
    points = np.array([[4.0, 5.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 5.0]])
    np.testing.assert_allclose(box.sdf(points), [5.0, -0.5, 3.0])
    # A quarter turn counter-clockwise from above brings +z to +x.
    long = Box((0.0, 0.0, 0.0), (2.0, 2.0, 4.0), np.pi / 4)
    assert long.sdf(np.array([[1.2, 0.0, 1.2]]))[0] < 0 < long.sdf(np.array([[-1.2, 0.0, 1.2]]))[0]
    t, normals = box.intersect(np.array([0.0, 0.0, -6.0]), np.array([[0.0, 0.0, 2.0]]))
    assert t[0] == 2.0
    assert normals[0].tolist() == [0.0, 0.0, -1.0]


def test_rays_stop_at_the_first_surface(solid):
    """Catches a far root taken for the near one, false misses, and normals that point inward."""
    rng = np.random.default_rng(1)
    if isinstance(solid, RoomShell):
        origins = rng.uniform(-0.45, 0.45, (1500, 3))
        directions = rng.normal(size=(1500, 3))
    else:
        origins = rng.normal(size=(1500, 3))
        origins *= 2.0 / np.linalg.norm(origins, axis=1, keepdims=True)
        directions = rng.uniform(-0.7, 0.7, (1500, 3)) - origins
    t, normals = solid.intersect(origins, directions)
    hit = np.isfinite(t)
    assert hit.mean() == 1 if isinstance(solid, RoomShell) else 0.1 < hit.mean() < 1
    points = origins[hit] + t[hit, None] * directions[hit]
    assert np.abs(solid.sdf(points)).max() < 1e-9
    end = np.where(hit, t, 3.0)[:, None]
    for fraction in np.linspace(0.0, 0.999, 60):
        assert solid.sdf(origins + fraction * end * directions).min() > 0
    outward = numerical_gradient(solid.sdf, points + 1e-4 * normals[hit])
    agree = (outward * normals[hit]).sum(axis=1) > 1 - 1e-6
    assert agree.mean() > 0.99  # the rest lies within the step of an edge
    assert (normals[~hit] == 0).all()


def test_axis_parallel_rays_have_no_division_by_zero():
    """Catches NaN where a ray runs along a face, an axis or a cylinder's side."""
    origins = np.array([0.0, 0.0, -3.0])
    along = np.array([[0.0, 0.0, 1.0]])
    assert Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)).hit(origins, along)[0] == 2.5
    rod = Cylinder((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), 0.2)
    assert rod.hit(origins, along)[0] == pytest.approx(2.0)
    assert rod.hit(origins + np.array([0.3, 0.0, 0.0]), along)[0] == np.inf


def test_room_sdf_is_the_distance_to_the_true_surface(room_name):
    """Catches a part left out of the distance, and surface points that miss or invent surface."""
    room = build_room(room_name)
    surface = true_surface_points(room, 150_000, 0)
    assert surface.shape == (150_000, 3)
    assert np.abs(room.sdf(surface)).max() < 1e-6
    points = free_points(room, 2000, np.random.default_rng(2))
    nearest, _ = cKDTree(surface).query(points)
    distance = room.sdf(points)
    assert (nearest - distance).min() > -1e-9
    assert (nearest - distance).max() < 0.12  # no hole between samples is wider
    assert (nearest - distance).mean() < 0.01


def test_room_sdf_has_unit_gradient(room_name):
    """Catches scaled or merely bounding distances: the eikonal equation holds in free space."""
    room = build_room(room_name)
    points = free_points(room, 3000, np.random.default_rng(3))
    norms = np.linalg.norm(numerical_gradient(room.sdf, points), axis=1)
    # Within a step of a place equally far from two surfaces the difference quotient is less.
    assert (np.abs(norms - 1) < 1e-6).mean() > 0.998
    limit = 0.3
    np.testing.assert_array_equal(
        room.sdf_up_to(points, limit), np.minimum(room.sdf(points), limit)
    )


def test_depth_ends_on_the_surface_and_the_way_there_is_free(room_name):
    """Catches Euclidean distance in place of z-depth, and surfaces that culling loses."""
    room = build_room(room_name)
    intrinsics = room_intrinsics(48, 36)
    for T_world_camera in handheld_trajectory(room, 240, 3)[::60]:
        color, depth, index = render_frame(room, intrinsics, T_world_camera)
        rows, columns = np.indices(depth.shape)
        directions_camera = np.stack(
            [
                (columns + 0.5 - intrinsics.cx) / intrinsics.fx,
                (rows + 0.5 - intrinsics.cy) / intrinsics.fy,
                np.ones(depth.shape),
            ],
            axis=-1,
        ).reshape(-1, 3)
        origin = T_world_camera[:3, 3]
        rays = depth.reshape(-1, 1) * directions_camera @ T_world_camera[:3, :3].T
        assert np.abs(room.sdf(origin + rays)).max() < 1e-9
        for fraction in np.linspace(0.0, 0.995, 40):
            assert room.sdf(origin + fraction * rays).min() > 0
        assert len(np.unique(index)) >= 3  # furniture is in view
        # Without a shared origin nothing is culled; the answer must be the same.
        t, _ = room.first_hit(np.tile(origin, (len(rays), 1)), rays)
        np.testing.assert_allclose(t, 1.0, atol=1e-9)
        assert 60 < color.mean() < 220  # neither dark ...
        assert (color == 255).mean() < 0.1  # ... nor burnt out


def test_rooms_differ():
    """Catches one room entered under several names."""
    points = np.random.default_rng(4).uniform([-1.6, 0.0, -1.6], [1.6, 2.4, 1.6], (2000, 3))
    values = [build_room(name).sdf(points) for name in ROOMS]
    assert len(values) == 11
    for i in range(len(values)):
        for j in range(i):
            assert np.abs(values[i] - values[j]).mean() > 0.05


def test_reported_rooms_exclude_those_that_settings_were_chosen_on():
    """Catches a tuned room in a reported table, and a room that no longer has its own name."""
    assert set(ROOMS) - set(REPORTED_ROOMS) == {"bedroom", "kitchen_nook"}
    assert len(REPORTED_ROOMS) == len(set(REPORTED_ROOMS)) == 9
    for name in ROOMS:
        assert build_room(name).name == name
    assert not set(ROOMS) & set(DATASET_SCENES)


@pytest.mark.parametrize(
    ("name", "position", "mean_depth", "mean_color"),
    [
        ("living_room", [0.160995568788, 1.558483334243, 0.480572893476], 2.416513743226, 145.697),
        ("office", [0.197053542691, 1.251187382997, 0.382083638681], 2.032130795526, 146.734),
        ("bedroom", [0.738312659003, 1.464429680512, 0.431316378481], 2.210760992694, 158.702),
        (
            "kitchen_nook",
            [-0.121330509117, 1.207724433708, 0.335660780400],
            1.885787240638,
            147.206,
        ),
    ],
)
def test_first_rooms_stay_as_they_are(name, position, mean_depth, mean_color):
    """Catches a change to a room or the motion that forgets to raise `ROOM_VERSION`."""
    room = build_room(name)
    pose = handheld_trajectory(room, 120, 0)[100]
    np.testing.assert_allclose(pose[:3, 3], position, atol=1e-9)
    color, depth, _ = render_frame(room, room_intrinsics(32, 24), pose)
    assert depth.mean() == pytest.approx(mean_depth, abs=1e-8)
    assert color.mean() == pytest.approx(mean_color, abs=0.05)


@pytest.fixture(scope="module")
def views() -> dict[str, list[tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """Color, depth and surface index of eight small pictures of each reported room."""
    intrinsics = room_intrinsics(64, 48)
    rooms = {name: build_room(name) for name in REPORTED_ROOMS}
    return {
        name: [render_frame(room, intrinsics, T) for T in handheld_trajectory(room, 300, 0)[::40]]
        for name, room in rooms.items()
    }


def steepness(color):
    """Mean change of brightness (of 255) from pixel to pixel, per pixel."""
    return np.hypot(*np.gradient(color.astype(np.float64).mean(axis=2)))


def assert_stands_out(values: dict[str, float], name: str, factor: float) -> None:
    others = max(value for other, value in values.items() if other != name)
    assert values[name] > factor * others, values


def test_texture_is_strong_in_one_room_and_low_in_another(views):
    """Catches a den that lost its patterns, and color or contrast that crept into the studio."""
    steep = {
        name: float(np.mean([steepness(color).mean() for color, _, _ in shots]))
        for name, shots in views.items()
    }
    colorful = {
        name: float(
            np.mean([np.ptp(color.astype(np.float64), axis=2).mean() for color, _, _ in shots])
        )
        for name, shots in views.items()
    }
    assert_stands_out(steep, "patchwork_den", 1.2)
    assert_stands_out({name: 1 / value for name, value in steep.items()}, "grey_studio", 1.1)
    assert_stands_out({name: 1 / value for name, value in colorful.items()}, "grey_studio", 5.0)
    assert steep["patchwork_den"] > 2 * steep["grey_studio"]


def test_gallery_is_bare(views):
    """Catches a gallery so full, or walls so loud, that bare wall no longer fills its views."""
    bare = {
        name: float(np.mean([((index == 0) & (steepness(color) < 3.0)).mean()
                             for color, _, index in shots]))
        for name, shots in views.items()
    }  # fmt: skip
    assert_stands_out(bare, "gallery", 1.25)


def is_rod(solid: Solid) -> bool:
    if isinstance(solid, Cylinder):
        return 2 * solid.radius < 0.05
    return isinstance(solid, Box) and sorted(solid.size)[1] < 0.05


def test_trellises_are_thin_and_in_view(views):
    """Catches thickened rods, and rods that stand where the camera never looks."""
    shares, seen = {}, {}
    for name, shots in views.items():
        parts = build_room(name).parts
        areas = np.array([part.solid.area() for part in parts])
        thin = np.array([is_rod(part.solid) for part in parts])
        shares[name] = float(areas[thin].sum() / areas.sum())
        rods = np.flatnonzero(thin) + 1
        seen[name] = float(np.mean([np.isin(index, rods).mean() for _, _, index in shots]))
    assert_stands_out(shares, "trellis_room", 5.0)
    assert shares["trellis_room"] > 0.2
    assert_stands_out(seen, "trellis_room", 2.0)


def longest_flight(name: str, rise: float = 0.2) -> int:
    """Largest number of boxes of the room whose tops follow each other at one rise."""
    boxes = [part.solid for part in build_room(name).parts if isinstance(part.solid, Box)]
    tops = np.array([box.center[1] + box.size[1] / 2 for box in boxes])
    counts = []
    for top in tops:
        count = 0
        while (np.abs(tops - (top + count * rise)) < 1e-6).any():
            count += 1
        counts.append(count)
    return max(counts, default=0)


def test_only_the_stairwell_has_stairs():
    """Catches a missing step, flights that do not meet, and a room too low for two of them."""
    flights = {name: float(longest_flight(name)) for name in REPORTED_ROOMS}
    assert flights["stairwell"] >= 14
    assert_stands_out(flights, "stairwell", 3.0)
    assert build_room("stairwell").bounds[1, 1] > 4.0


def test_views_along_the_hall_are_near_and_far(views):
    """Catches a hall that is wide or short: its walls are near, its ends are far."""
    ranges = {
        name: float(np.divide(*np.percentile([depth for _, depth, _ in shots], [99, 5])))
        for name, shots in views.items()
    }
    assert min(ranges["long_hall"], ranges["two_rooms"]) > 3.0
    width, _, length = np.ptp(build_room("long_hall").bounds, axis=0)
    assert length > 3.5 * width
    assert all(value < 3.0 for name, value in ranges.items() if build_room(name).walk.end is None)


def test_depth_is_that_of_a_room(views):
    """Catches a camera that faces a wall all the time, and one lost in a hall."""
    for name, shots in views.items():
        depths = np.array([depth for _, depth, _ in shots])
        assert ((depths > 0.6) & (depths < 4.5)).mean() > 0.95, name
        assert np.median(depths) > 1.5, name


@pytest.mark.parametrize("name", [name for name in ROOMS if build_room(name).walk.end is not None])
def test_a_walk_with_two_places_visits_both(name):
    """Catches a drift that stays at one place, takes another time, or does not come back."""
    room = build_room(name)
    start, end = np.array(room.walk.center), np.array(room.walk.end)
    assert 1.0 <= np.linalg.norm(end - start) <= 1.3
    n_frames = 2 * CROSSING_FRAMES + 1
    positions = handheld_trajectory(room, n_frames, 0)[:, :3, 3]
    along = (positions[:, [0, 2]] - start) @ (end - start) / ((end - start) @ (end - start))
    assert along[0] < 0.4
    assert along[CROSSING_FRAMES] > 0.6
    assert along[-1] < 0.4


@pytest.mark.parametrize("seed", range(5))
def test_camera_passes_the_doorway(seed):
    """Catches a camera that stays on one side of the dividing wall within 300 frames."""
    room = build_room("two_rooms")
    T_world_camera = handheld_trajectory(room, 300, seed)
    z = T_world_camera[:, 2, 3]
    assert (z > 0.2).mean() > 0.2
    assert (z < -0.2).mean() > 0.2
    assert room.sdf(np.array([[-1.0, 1.4, 0.0], [1.0, 1.4, 0.0], [0.0, 2.4, 0.0]])).max() < 0
    assert room.sdf(np.array([[0.0, 1.4, 0.0]]))[0] > 0.6
    # It looks ahead, along -z, when it passes: the other room comes into view.
    assert T_world_camera[np.abs(z).argmin(), 2, 2] < -0.7


def test_stairs_by_hand():
    """Catches steps that float, overlap or rise the wrong way, and a rail off its posts."""
    oak = Plain((0.5, 0.4, 0.3))
    steps = [part.solid for part in staircase((1.0, 2.0), (0.0, -1.0), 3, (0.9, 0.2, 0.3), oak)]
    assert [step.size for step in steps] == [(0.9, pytest.approx(0.2 * n), 0.3) for n in (1, 2, 3)]
    np.testing.assert_allclose(
        [step.center for step in steps], [[1.0, 0.1, 1.85], [1.0, 0.2, 1.55], [1.0, 0.3, 1.25]]
    )
    (tread,) = staircase((0.0, 0.0), (-1.0, 0.0), 1, (0.9, 0.2, 0.3), oak, 1.0, 0.05)
    np.testing.assert_allclose(tread.solid.size, (0.3, 0.05, 0.9))
    np.testing.assert_allclose(tread.solid.center, (-0.15, 1.175, 0.0))
    *posts, rail = banister((0.0, 0.2, 0.0), (0.0, 1.4, -1.6), 4, oak, oak)
    heads = np.array([post.solid.end for post in posts])
    np.testing.assert_allclose(heads[:, 1], [1.1, 1.5, 1.9, 2.3])
    np.testing.assert_allclose(rail.solid.sdf(heads), -0.032, atol=1e-12)


def test_materials_of_many_rooms():
    """Catches patches that lie outside of [0, 1] or do not vary, and sides that are swapped."""
    points = np.random.default_rng(6).uniform(-2, 2, (5000, 3))
    colors = Patchwork((0.5, 0.5, 0.5), 0.3, 0.5, 1).albedo(points, np.zeros_like(points))
    assert colors.min() >= 0.0
    assert colors.max() <= 1.0
    assert colors.std(axis=0).min() > 0.1
    split = Split(Plain((0.1, 0.1, 0.1), 0.0), Plain((0.9, 0.9, 0.9), 0.0), 2, 0.5)
    np.testing.assert_allclose(
        split.albedo(points, np.zeros_like(points))[:, 0], np.where(points[:, 2] > 0.5, 0.9, 0.1)
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_motion_is_hand_held(room_name, seed):
    """Catches paths too fast, too jerky, too near to furniture, or that stare at one spot."""
    room = build_room(room_name)
    T_world_camera = handheld_trajectory(room, 240, seed)
    statistics = motion_statistics(T_world_camera)
    assert 5 <= statistics.mean_mm <= 7
    assert statistics.max_mm <= 18
    assert 0.5 <= statistics.mean_deg <= 0.8
    assert statistics.max_deg <= 1.95
    positions = T_world_camera[:, :3, 3]
    assert room.sdf(positions).min() >= 0.35
    assert positions[:, 1].min() >= 1.1
    assert positions[:, 1].max() <= 1.7
    rotation = T_world_camera[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (240, 1, 1)), atol=1e-12
    )
    assert (rotation[:, 1, 1] < -0.7).all()  # OpenCV's y axis points down: the camera is upright
    assert np.linalg.norm(np.diff(positions, n=2, axis=0), axis=1).max() < 4e-3
    heading = np.unwrap(np.arctan2(rotation[:, 0, 2], rotation[:, 2, 2]))
    assert np.degrees(np.ptp(heading)) > 80


def test_long_walk_sees_all_around():
    """Catches a path that never turns fully: 700 frames at 0.65° are more than one turn."""
    T_world_camera = handheld_trajectory(build_room("bedroom"), 700, 5)
    heading = np.unwrap(np.arctan2(T_world_camera[:, 0, 2], T_world_camera[:, 2, 2]))
    assert np.degrees(np.ptp(heading)) > 300
    assert 5 <= motion_statistics(T_world_camera).mean_mm <= 7


def test_walks_of_every_reported_length_exist(room_name):
    """Catches a room in which no path of the usual 300 frames or of a long run can be found."""
    room = build_room(room_name)
    for seed in (3, 4):
        assert len(handheld_trajectory(room, 300, seed)) == 300
    assert len(handheld_trajectory(room, 1000, 0)) == 1000


def test_sensor_range_and_invalid_pixels():
    """Catches readings where a real sensor has none."""
    for depth in (0.0, 0.3, 9.0, np.inf, np.nan):
        image = np.full((48, 64), depth)
        assert (add_kinect_noise(image, FOCAL / 10, np.random.default_rng(0)) == 0).all()
    image = np.full((48, 64), 2.0)
    assert (add_kinect_noise(image, FOCAL / 10, np.random.default_rng(0)) > 0).all()


@pytest.mark.parametrize(("depth", "step"), [(1.0, 0.00301), (2.0, 0.0120), (4.0, 0.0481)])
def test_quantization_grows_with_the_square_of_depth(depth, step):
    """Catches rounding of depth instead of disparity: step = z² / (8 · 554.26 · 0.075)."""
    slope = np.linspace(0.95, 1.05, 640)[None].repeat(480, axis=0)
    noisy = add_kinect_noise(depth * slope, FOCAL, np.random.default_rng(1))
    levels = np.unique(noisy[noisy > 0])
    assert np.median(np.diff(levels)) == pytest.approx(step, rel=0.08)
    errors = (noisy - depth * slope)[noisy > 0]
    assert step / 4 < errors.std() < step  # half a step of noise and the rounding
    assert abs(errors.mean()) < step / 10


def test_dropout_at_edges_and_grazing_surfaces_only():
    """Catches edges that survive, and slanted planes mistaken for edges."""
    rng = np.random.default_rng(2)
    step = np.full((96, 128), 1.5)
    step[:, 64:] = 3.0
    lost = add_kinect_noise(step, FOCAL / 5, rng) == 0
    assert 0.4 < lost[:, 63:65].mean() < 0.8
    assert not lost[:, :62].any()
    assert not lost[:, 66:].any()
    # A floor 1.4 m below the camera: depth at row v is 1.4 f / v; at 8° it is too oblique.
    row_offset = np.arange(60) + 2.5
    floor = (1.4 * (FOCAL / 5) / row_offset)[:, None].repeat(128, axis=1)
    lost = add_kinect_noise(floor, FOCAL / 5, rng) == 0
    assert not lost[(floor > 1.0) & (floor < 5.0)].any()


def test_grazing_surface_is_lost():
    """Catches a missing incidence limit: a plane seen at 85 degrees from its normal."""
    x = (np.arange(128) + 0.5 - 64) / (FOCAL / 5)
    tilt = np.tan(np.radians(85))
    depth = (2.0 / (1 - tilt * x[None, 62:66])).repeat(96, axis=0)
    wide = np.pad(depth, ((0, 0), (62, 62)), mode="edge")
    lost = add_kinect_noise(wide, FOCAL / 5, np.random.default_rng(3)) == 0
    assert lost[:, 63:65].all()


def test_filter_reduces_noise_and_leaves_holes():
    """Catches a filter that fills holes, is pulled by them, or blurs over edges."""
    # Slightly slanted, so that rounding errors vary as in nature; a step in the middle.
    exact = np.linspace(2.0, 2.2, 240)[:, None].repeat(320, axis=1)
    exact[:, 160:] += 1.0
    noisy = add_kinect_noise(exact, FOCAL / 2, np.random.default_rng(4))
    noisy[50:60, 50:60] = 0
    smooth = filter_depth(noisy)
    np.testing.assert_array_equal(smooth == 0, noisy == 0)
    valid = noisy > 0
    valid[:, 157:163] = False  # sideways jitter moves the edge itself
    assert (smooth - exact)[valid].std() < 0.6 * (noisy - exact)[valid].std()
    assert np.abs(smooth - exact)[valid].max() < 0.06
    holed = np.full((48, 64), 0.5)
    holed[20:30, 20:30] = 0
    np.testing.assert_allclose(filter_depth(holed)[holed > 0], 0.5, atol=1e-6)


def folder_bytes(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_rooms_are_bit_identical_for_a_seed(tmp_path):
    """Catches hidden randomness, and a result that depends on the number of processes."""
    seen = []
    first = make_room("office", tmp_path / "a", 4, 32, 24, 7, progress=lambda *a: seen.append(a))
    again = make_room("office", tmp_path / "b", 4, 32, 24, 7, workers=2)
    other = make_room("office", tmp_path / "c", 4, 32, 24, 8)
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert folder_bytes(first) == folder_bytes(again)
    assert folder_bytes(first)["images/img0.png"] != folder_bytes(other)["images/img0.png"]


def test_round_trip_through_the_reader(tmp_path):
    """Catches a layout the reader does not take, swapped axes, and lost exactness of poses."""
    folder = make_room("living_room", tmp_path / "scene", 3, 40, 30, 1)
    frames = list(room_frames(build_room("living_room"), 3, 40, 30, 1))
    for depth_folder in ("depth", "depth_with_noise", "depth_filtered"):
        sequence = read_sequence(folder, depth_folder=depth_folder)
        assert sequence.intrinsics == room_intrinsics(40, 30)
        np.testing.assert_array_equal(sequence.colors, [frame.color for frame in frames])
        np.testing.assert_array_equal(
            sequence.depths_mm, [frame.depths_mm[depth_folder] for frame in frames]
        )
        np.testing.assert_array_equal(
            sequence.T_world_camera, [frame.T_world_camera for frame in frames]
        )
    room = room_of(folder)
    assert room is not None
    assert room.name == "living_room"
    assert room_of(tmp_path) is None


def test_user_errors(tmp_path):
    """Catches tracebacks of the wrong kind, and half a folder left by a call that failed."""
    with pytest.raises(MissingError, match="did you mean 'kitchen_nook'"):
        make_room("kitchen", tmp_path / "a", 4, 32, 24)
    with pytest.raises(ConfigError, match="frames = 1"):
        make_room("office", tmp_path / "a", 1, 32, 24)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(DataError, match="exists"):
        make_room("office", tmp_path, 4, 32, 24)
    (tmp_path / "room.json").write_text("{")
    with pytest.raises(DataError, match="make the room again"):
        room_of(tmp_path)
    (tmp_path / "room.json").write_text(json.dumps({"room": "office", "version": 0}))
    with pytest.raises(DataError, match="version 0"):
        room_of(tmp_path)
    with pytest.raises(ConfigError, match="at least 2"):
        handheld_trajectory(build_room("office"), 1, 0)
