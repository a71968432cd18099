"""The synthetic rooms: exact geometry, exact depth, human motion, a believable sensor."""

import filecmp
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial import cKDTree

from nbtrack.machinery.errors import DataError
from nbtrack.recordings.reading import read_sequence
from nbtrack.synthetic import keyframe_trajectory, make_room, room_frames, room_intrinsics, room_of
from nbtrack.synthetic.motion import handheld_trajectory, tour
from nbtrack.synthetic.primitives import Box, Cylinder, RoomShell, Sphere
from nbtrack.synthetic.render import add_kinect_noise, filter_depth, render_frame
from nbtrack.synthetic.room import ROOMS, Room, build_room

SOLIDS = {
    "box": Box((0.1, -0.2, 0.3), (0.8, 0.5, 1.1)),
    "turned box": Box((0.1, -0.2, 0.3), (0.8, 0.5, 1.1), 0.6),
    "sphere": Sphere((-0.1, 0.2, 0.1), 0.5),
    "upright cylinder": Cylinder((0.2, -0.5, 0.1), (0.2, 0.4, 0.1), 0.3),
    "leaning rod": Cylinder((-0.4, -0.5, 0.0), (0.4, 0.5, 0.3), 0.12),
    "shell": RoomShell((0.05, 0.05, -0.05), (1.5, 1.1, 1.1)),
}
FOCAL = 554.2562584220407  # 640 / (2 tan 30°)
EACH_ROOM = {name: build_room(name) for name in ROOMS}
path_of, keyframes_of = cache(handheld_trajectory), cache(keyframe_trajectory)
each_room = pytest.mark.parametrize("room", [*EACH_ROOM.values()], ids=ROOMS)


def numerical_gradient(sdf, points, step=1e-6):
    """Central differences of a distance function."""
    offsets = step * np.eye(3)
    return np.stack([sdf(points + o) - sdf(points - o) for o in offsets], axis=1) / (2 * step)


def norms(vectors):
    return np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("body", [*SOLIDS.values(), *EACH_ROOM.values()], ids=[*SOLIDS, *ROOMS])
def test_rays_and_distances_find_the_first_surface(body):
    """Catches a distance that is only a bound, a part left out, a solid that the limit drops; a far
    root taken for the near one, false misses, and normals that point inward."""
    rng = np.random.default_rng(0)
    if isinstance(body, Room):
        shell, hit = body.parts[0].solid, lambda *rays: body.first_hit(*rays)[0]
        points = rng.uniform(-0.5, 0.5, (200, 3)) * 2 * shell.half + shell.center
        points = points[body.sdf(points) > 1e-3]  # where bodies overlap it is a bound
        nearby = np.minimum(body.sdf(points), 0.3)
        np.testing.assert_allclose(body.sdf(points, 0.3), nearby, atol=1e-12)
        origins = np.repeat(points, 250, axis=0)
        directions = rng.normal(size=origins.shape)
    else:
        hit, points = body.hit, rng.uniform(-1.2, 1.2, (200, 3))
        # Chords of a sphere, and rays from within the shell, reach all of a convex surface.
        origins, ends = rng.normal(size=(2, 200_000, 3))
        origins *= (0.4 if body is SOLIDS["shell"] else 1.2) / norms(origins)
        directions = 1.2 * ends / norms(ends) - origins
    t = hit(origins, directions)
    met = np.isfinite(t)
    surface = origins[met] + t[met, None] * directions[met]
    assert len(surface) > 10_000
    assert np.abs(body.sdf(surface)).max() < 1e-6
    way = np.linspace(0.0, 0.999, 30)[:, None, None] * directions[:300]
    way = origins[:300] + np.where(met, t, 1.0)[:300, None] * way
    assert body.sdf(way.reshape(-1, 3)).min() > 0
    excess = cKDTree(surface).query(points)[0] - np.abs(body.sdf(points))
    assert excess.min() > -1e-9
    assert excess.max() < (0.25 if isinstance(body, Room) else 0.06)  # no wider hole in the samples
    assert excess.mean() < 0.02
    # Within a step of a place equally far from two surfaces the difference quotient is less.
    assert (np.abs(norms(numerical_gradient(body.sdf, points)) - 1) < 1e-6).mean() > 0.99
    if not isinstance(body, Room):
        normals = body.normals(surface[:1000])
        outward = numerical_gradient(body.sdf, surface[:1000] + 1e-4 * normals)
        # The rest lies within the step of an edge.
        assert ((outward * normals).sum(axis=1) > 1 - 1e-6).mean() > 0.99


def test_values_by_hand():
    """Catches 0/0 for rays along faces. Sizes and turns of boxes: the recorded views."""
    origin, along = np.array([0.0, 0.0, -6.0]), np.array([[0.0, 0.0, 2.0]])
    assert Box((0.0, 0.0, 0.0), (2.0, 2.0, 4.0)).hit(origin, along)[0] == 2.0
    rod = Cylinder((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), 0.2)
    assert rod.hit(origin, along)[0] == pytest.approx(2.5)
    assert rod.hit(origin + np.array([0.3, 0.0, 0.0]), along)[0] == np.inf


# Of one view: the camera's position (m), mean depth (m) and mean colour; then where a pose of the
# key frames and of the tour has the point (1, 2, 3) m. Motion was compared with the dataset's.
RECORDED = pd.read_csv(Path(__file__).parent / "data/room_views.csv", index_col="room")


@each_room
def test_views_are_exact_and_stay_as_they_are(room):
    """Catches distance for z-depth, surfaces lost by culling, changes without a `ROOM_VERSION`."""
    camera, pose = room_intrinsics(32, 24), path_of(room, 120, 0)[100]
    color, depth, index = render_frame(room, camera, pose)
    recorded = RECORDED.loc[room.name]
    np.testing.assert_allclose([*pose[:3, 3], depth.mean()], recorded[:4], rtol=0, atol=1e-8)
    poses = np.stack([keyframes_of(room, 300, 0)[200], tour(room, 1200, 0)[600]])
    np.testing.assert_allclose((poses @ [1, 2, 3, 1])[:, :3].ravel(), recorded[5:], atol=1e-8)
    assert color.mean() == pytest.approx(recorded["color"], abs=0.05)
    rows, columns = np.indices(depth.shape)
    x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
    points_camera = np.stack([depth * x, depth * y, depth], axis=-1).reshape(-1, 3)
    origin, rays = pose[:3, 3], points_camera @ pose[:3, :3].T
    assert np.abs(room.sdf(origin + rays)).max() < 1e-9
    # The parts one by one, where nothing is culled: the answer must be the same.
    hits = [part.solid.hit(origin, rays) for part in room.parts]
    np.testing.assert_allclose(np.min(hits, axis=0), 1.0, atol=1e-9)
    assert len(np.unique(index)) >= 3  # furniture is in view
    assert (color == 255).mean() < 0.1  # not burnt out


@each_room
def test_a_long_path_of_key_frames_goes_to_and_fro(room):
    """Catches rooms that are refused, as they are too small for a longer path, and jumps at its
    ends: it passes its poses again in the opposite order."""
    poses = keyframes_of(room, 700, 0)
    np.testing.assert_array_equal(poses[:300], keyframes_of(room, 300, 0))
    np.testing.assert_array_equal(poses[299:598], poses[299::-1][:299])
    np.testing.assert_array_equal(poses[598:], poses[:102])


def test_sensor_range_and_invalid_pixels():
    """Catches readings where a real sensor has none, and none where it has."""
    for depth in (0.0, 0.3, 2.0, 9.0, np.inf, np.nan):
        measured = add_kinect_noise(np.full((48, 64), depth), 55.0, np.random.default_rng(0)) > 0
        assert (measured == (depth == 2.0)).all()


@pytest.mark.parametrize(("depth", "step"), [(1.0, 0.00301), (2.0, 0.0120), (4.0, 0.0481)])
def test_quantization_grows_with_the_square_of_depth(depth, step):
    """Catches rounding of depth instead of disparity: step = z² / (8 · 554.26 · 0.075)."""
    slope = np.linspace(0.95, 1.05, 640)[None].repeat(480, axis=0)
    noisy = add_kinect_noise(depth * slope, FOCAL, np.random.default_rng(1))
    assert np.median(np.diff(np.unique(noisy[noisy > 0]))) == pytest.approx(step, rel=0.08)
    errors = (noisy - depth * slope)[noisy > 0]
    assert step / 4 < errors.std() < step  # half a step of noise and the rounding
    assert abs(errors.mean()) < step / 10


def test_dropout_at_edges_and_grazing_surfaces_only():
    """Catches edges that survive, and slanted planes mistaken for edges or for grazing ones."""
    focal = FOCAL / 5
    step = np.full((96, 128), 1.5)
    step[:, 64:] = 3.0
    # A floor 1.4 m below the camera: depth at row v is 1.4 f / v; at 8° it is too oblique.
    floor = (1.4 * focal / (np.arange(60) + 2.5))[:, None].repeat(128, axis=1)
    # A plane seen at 85 degrees from its normal.
    x = (np.arange(62, 66) + 0.5 - 64) / focal
    plane = (2.0 / (1 - np.tan(np.radians(85)) * x))[None].repeat(96, axis=0)
    plane = np.pad(plane, ((0, 0), (62, 62)), mode="edge")
    rng = np.random.default_rng(2)
    lost = [add_kinect_noise(depth, focal, rng) == 0 for depth in (step, floor, plane)]
    assert 0.4 < lost[0][:, 63:65].mean() < 0.8
    assert not np.delete(lost[0], range(62, 66), axis=1).any()
    assert not lost[1][(floor > 1.0) & (floor < 5.0)].any()
    assert lost[2][:, 63:65].all()


def test_filter_reduces_noise_and_leaves_holes():
    """Catches a filter that fills holes, is pulled by them, or blurs over edges."""
    # Slightly slanted, so that rounding errors vary as in nature; a step in the middle.
    exact = np.linspace(2.0, 2.2, 240)[:, None].repeat(320, axis=1)
    exact[:, 160:] += 1.0
    noisy = add_kinect_noise(exact, FOCAL / 2, np.random.default_rng(4))
    noisy[50:60, 50:60] = 0
    smooth, valid = filter_depth(noisy), noisy > 0
    np.testing.assert_array_equal(smooth > 0, valid)
    valid[:, 157:163] = False  # sideways jitter moves the edge itself
    assert (smooth - exact)[valid].std() < 0.6 * (noisy - exact)[valid].std()
    assert np.abs(smooth - exact)[valid].max() < 0.06


def test_rooms_are_bit_identical_for_a_seed(tmp_path, monkeypatch):
    """Catches hidden randomness, a result that depends on the number of threads, a layout that the
    reader does not take, and lost exactness of poses."""
    seen = []
    first = make_room("office", tmp_path / "a", 3, 16, 12, 7, progress=seen.append)
    monkeypatch.setattr("nbtrack.synthetic.make.usable_cores", lambda: 1)
    again = make_room("office", tmp_path / "b", 3, 16, 12, 7)
    other = make_room("office", tmp_path / "c", 3, 16, 12, 8)
    assert seen == [1, 2, 3]
    files = [path.relative_to(first) for path in first.rglob("*.*")]
    assert filecmp.cmpfiles(first, again, files, shallow=False)[0] == files
    assert not filecmp.cmp(first / "images/img0.png", other / "images/img0.png", shallow=False)
    frames = room_frames(EACH_ROOM["office"], 3, 16, 12, 7)
    color, depths_mm, T_world_camera = zip(*frames, strict=True)
    for depth_folder in ("depth", "depth_with_noise", "depth_filtered"):
        sequence = read_sequence(first, depth_folder=depth_folder)
        assert sequence.intrinsics == room_intrinsics(16, 12)
        np.testing.assert_array_equal(sequence.colors, color)
        np.testing.assert_array_equal(sequence.depths_mm, [d[depth_folder] for d in depths_mm])
        np.testing.assert_array_equal(sequence.T_world_camera, T_world_camera)
    assert room_of(first).name == "office"
    assert room_of(tmp_path) is None


def test_user_errors(tmp_path):
    """Catches tracebacks of the wrong kind."""
    for content, message in (("{", "again"), ('{"room": "office", "version": 0}', "version 0")):
        (tmp_path / "room.json").write_text(content)
        with pytest.raises(DataError, match=message):
            room_of(tmp_path)
