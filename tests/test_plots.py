"""Figures: every axis has its unit, every line lies where the data are, nothing leaks."""

import io
from dataclasses import replace
from types import SimpleNamespace

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import torch
import trimesh
from box_room import Formula, sequence_of
from IPython.core.formatters import DisplayFormatter
from matplotlib.contour import ContourSet
from PIL import Image, ImageSequence

from nbtrack import plots
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.fields import NetworkSettings, make_field
from nbtrack.plots.idea import plot_idea
from nbtrack.plots.movie import view_of
from nbtrack.plots.network import plot_network
from nbtrack.plots.pose_losses import move_sideways, plot_density, plot_pose_losses, pose_losses
from nbtrack.plots.scene import screen_axes
from nbtrack.plots.style import PALETTE, method_colors
from nbtrack.tracking import SdfSettings, StepBudget, Tracker, make_tracker

CUBE = SceneBounds((-2.0,) * 3, (2.0,) * 3)
ROOM = SimpleNamespace(sdf=lambda points: 1.5 - np.linalg.norm(points, axis=1))

# A hollow sphere around the origin: the distance, positive inside, and a density (1/m).
SPHERE = Formula(lambda points: 1.5 - points.norm(dim=-1), CUBE)
NEAR = Formula(lambda points: 1.05 - points.norm(dim=-1), CUBE)  # its front is what is measured
FOG = Formula(lambda p: 20 * torch.exp(5 * (p.norm(dim=-1) - 1.5)), CUBE)
FOG.surface_level = 20.0
SWEEP = pd.DataFrame({"time (ms)": [1.0, 9.0], "ATE (cm)": [2.0, 0.5], "method": ["VR", "SDF"]})
AT, RAY = torch.linspace(0, 2, 20), torch.linspace(1, -1, 20).requires_grad_()
END = {"measured depth": 1.2}
FRAMES = pd.DataFrame({
    "frame_id": [33, 36], "time": [1.1, 1.2], "translation_error_m": [0.01, 0.3],
    "rotation_error_deg": [0.1, 0.2], "still_error_m": [0.02, 0.04],
})  # fmt: skip
CLOUD = pd.DataFrame(np.random.default_rng(0).uniform(0, 1, (50, 6)))
CLOUD.columns = ["x", "y", "z", "red", "green", "blue"]


@pytest.fixture(scope="module")
def sequence():
    """Six frames from the origin along +z, everything at 1 m but one pixel without depth."""
    colors = np.random.default_rng(0).integers(0, 256, (6, 12, 16, 3), dtype=np.uint8)
    depths_mm = np.full((6, 12, 16), 1000)
    depths_mm[:, 2, 3] = 0
    T_world_camera = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (6, 1, 1))  # upright, y is up
    T_world_camera[:, 0, 3] = 0.01 * np.arange(6)
    return sequence_of(depths_mm, Intrinsics.from_focal(16, 12, 12.0), colors, T_world_camera)


def room_mesh() -> trimesh.Trimesh:
    """A box whose faces look inwards."""
    mesh = trimesh.creation.box((4.0, 2.0, 3.0))
    mesh.invert()
    mesh.visual.vertex_colors = np.full((8, 4), 200, np.uint8)
    return mesh


def steps_of(sequence) -> Tracker:
    """A tracker that starts 5 cm beside the first frame."""
    own = sequence.T_world_camera[5], StepBudget(3), SdfSettings(n_pixels=8)
    return make_tracker("sdf", NEAR, *own)


FAR = torch.linspace(-0.05, 0.05, 12 * 16 - 1)  # m, of the measured pixels of a frame
IMAP_FIELD = make_field("imap", NetworkSettings(width=8), CUBE, seed=0)
COLUMNS = pd.DataFrame({"a (m)": [1.0, 2.0], "b (cm)": [3.0, 4.0]}).rename_axis("step (s)")
FIGURES = {
    "network": lambda s: plot_network(IMAP_FIELD.mlp, "density (1/m)", "eight wide"),
    "frame": lambda s: plots.plot_frame(s, 3, "one"),
    "ray": lambda s: plots.plot_along_ray(AT, {"true": RAY, "b": RAY[:-1]}, END, "end", "d (m)"),
    "columns": lambda s: plots.plot_columns({"one": COLUMNS, "two": 2 * COLUMNS}, "rise"),
    "slice": lambda s: plots.plot_slice(SPHERE, s, 0.0, title="round"),
    "density": lambda s: plots.plot_slice(FOG, s, 0.0, title="round"),
    "distances": lambda s: plots.plot_distances(s[0], {"start": FAR, "end": FAR / 2}, "closer"),
    "mesh": lambda s: plots.plot_mesh({"NeuS": room_mesh()}, {"SDF": s.T_world_camera}, "room"),
    "figure 1": lambda s: plots.plot_map_and_slice(
        NEAR, s, {"true": s.T_world_camera}, "round", voxel=0.1
    ),
    "recording": lambda s: plots.plot_overview(CLOUD, {"true": s.T_world_camera}, None, "thin"),
    "overview": lambda s: plots.plot_overview(CLOUD, {"SDF": s.T_world_camera}, FRAMES, "near"),
    "errors": lambda s: plots.plot_errors({"VR": FRAMES, "SDF": FRAMES}, "lost"),
    "curves": lambda s: plots.plot_curves(SWEEP, *SWEEP, "fast"),
    "samples": lambda s: plot_idea(IMAP_FIELD, s[0], {"": s.T_world_camera[0]}, (6, 8), "many"),
    "both losses": lambda s: plot_pose_losses(IMAP_FIELD, NEAR, s[0], 4.0),
    "no density": lambda s: plot_density(pose_losses(IMAP_FIELD, NEAR, s[0]), "elsewhere"),
    "steps": lambda s: plots.plot_steps({"SDF": steps_of(s)}, s[0], s.T_world_camera[5]),
    "queries": lambda s: plot_idea(
        SPHERE, s[0], dict(zip("ab", s.T_world_camera, strict=False)), (6, 8), "one", before=0.9
    ),
}  # fmt: skip


def is_labelled(axis) -> bool:
    """Whether an axis without numbers, or with a label that names a unit or what it counts."""
    shows_numbers = any(t.get_text() and t.get_visible() for t in axis.get_ticklabels())
    return not shows_numbers or axis.label.get_text().endswith((")", "iteration", "step", "frame"))


@pytest.mark.parametrize("name", FIGURES)
def test_every_axis_has_a_unit_and_nothing_leaks(name: str, sequence) -> None:
    """Catches an unlabelled axis, a lost title, a figure too large for a notebook or shown twice by
    pyplot, an address in its text, and a style that leaks into a user's own plots."""
    before = dict(matplotlib.rcParams)
    figure = FIGURES[name](sequence)
    assert dict(matplotlib.rcParams) == before
    shown, described = DisplayFormatter().format(figure)
    assert shown["image/png"].startswith(b"\x89PNG")
    assert len(shown["image/png"]) < 200_000
    assert described["image/png"]["alt"] == figure.get_suptitle() != ""
    assert " at 0x" not in repr(figure)
    for axes in figure.axes:
        assert not axes.axison or (is_labelled(axes.xaxis) and is_labelled(axes.yaxis))
    assert plt.get_fignums() == []


def test_curves_of_methods_and_sweeps() -> None:
    """Catches a group without its own line, colour or mark, a variant that looks like another
    method or like its own, text sorted by letters, and spans drawn elsewhere."""
    axes = plots.plot_curves(SWEEP.assign(**{"from": 0.5, "to": 4.0}), *SWEEP).axes[0]
    looks = [(line.get_label(), line.get_color(), line.get_marker()) for line in axes.lines]
    assert looks == [("VR", PALETTE[0], "o"), ("SDF", PALETTE[1], "s")]
    assert axes.collections[0].get_segments()[0][:, 1].tolist() == [0.5, 4.0]
    lines = plots.plot_curves(SWEEP.replace({"VR": "SDF, far"}), *SWEEP).axes[0].lines
    looks = [(line.get_color(), line.get_marker(), line.get_linestyle()) for line in lines]
    assert looks == [(PALETTE[1], "o", "--"), (PALETTE[1], "o", "-")]
    words = SWEEP.replace({"time (ms)": {1.0: "b", 9.0: "a"}})
    axes = plots.plot_curves(words, *SWEEP, log="y").axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["b", "a"]
    assert [line.get_linestyle() for line in axes.lines] == ["None", "None"]
    assert axes.get_yscale() == "log"


def test_intervals_stand_in_the_row_of_their_set() -> None:
    """Catches a panel that orders its sets by itself, so that rows would have another's label, an
    interval or a text in another row, a mark filled where nothing is shown, and a legend that does
    not say what filled marks are."""
    columns = ["set", "method", "share (%)", "from", "to", "text", "shown"]
    rows = [["b", "VR", 50.0, 20.0, 80.0, "9", True], ["a", "VR", 0.0, 0.0, 30.0, "1", False]]
    table = pd.DataFrame(rows, columns=columns)
    panels = {"one": table, "two": table[::-1]}
    figure = plots.plot_intervals(panels, columns[2], "more")
    assert [text.get_text() for text in figure.legends[0].texts] == ["VR", "filled: shown"]
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == ["b", "a"]
    for axes, order in zip(figure.axes, ([0, 1], [1, 0]), strict=True):
        lines, points, _ = axes.collections
        ends = [[[rows[i][3], i], [rows[i][4], i]] for i in order]
        assert [line.tolist() for line in lines.get_segments()] == ends
        assert points.get_offsets().tolist() == [[rows[i][2], i] for i in order]
        assert [color.min() < 1 for color in points.get_facecolors()] == [rows[i][6] for i in order]
        of_row = {text.get_position()[1]: text.get_text() for text in axes.texts}
        assert of_row == {0: "9", 1: "1"}


def test_panels_share_rows_and_limits() -> None:
    """Catches a point in another row than its text, and a panel without a limit or with another."""
    cm = pd.DataFrame({"VR": [1.0, 30.0], "SDF": [2.0, 3.0]}, index=["a", "b"])
    panels = {"all": cm, "second row": cm.loc[["b"]]}
    figure = plots.plot_panels(panels, "ATE (cm)", limits={"lost": 20, "still": 60})
    for axes, table in zip(figure.axes, panels.values(), strict=True):
        lines = {line.get_label(): line for line in axes.lines}
        assert [*lines] == ["VR", "SDF", "lost", "still"]
        assert lines["VR"].get_xdata().tolist() == table["VR"].tolist()
        assert [*lines["SDF"].get_ydata()] == [["a", "b"].index(row) for row in table.index]
        assert [*lines["lost"].get_xdata()] == [20, 20]
        assert lines["lost"].get_linestyle() != lines["still"].get_linestyle()


def held(sequence, up: tuple[float, float, float]):
    """The same frames, with the cameras held upright in a world whose up is another."""
    T_world_camera, right = sequence.T_world_camera.copy(), np.roll(up, 1)
    T_world_camera[:, :3, :3] = np.stack([right, -np.array(up), -np.cross(right, up)], axis=1)
    return replace(sequence, T_world_camera=T_world_camera)


@pytest.mark.parametrize("field", [SPHERE, FOG])
@pytest.mark.parametrize(("height", "up"), [(0.0, (0, 1, 0)), (0.9, (0, -1, 0)), (0.9, (0, 0, 1))])
def test_the_zero_level_lies_on_the_sphere(sequence, field, height, up) -> None:
    """Catches swapped grid axes, a wrong height or level, pixels off by half, and a field and the
    true surface drawn in different frames."""
    drawn = plots.plot_slice(field, held(sequence, up), height, ROOM).axes[0].collections
    lines = [c for c in drawn if isinstance(c, ContourSet) and c.get_linewidths()[0] > 1]
    assert len(lines) == 2  # the thick ones: of the surface, and of the true one
    for line in lines:
        circle = np.concatenate([path.vertices for path in line.get_paths()])
        radius = np.sqrt(1.5**2 - height**2)
        assert np.linalg.norm(circle, axis=1) == pytest.approx(radius, abs=2e-3)
    along = Formula(lambda points: points @ torch.tensor(up, dtype=torch.float32), CUBE)
    values = plots.plot_slice(along, held(sequence, up), height).axes[0].collections[0].get_array()
    assert values.mean() == pytest.approx(height, abs=1e-4)


def test_what_was_not_seen_is_veiled(sequence) -> None:
    """Catches a veil that is mirrored, shifted, or over what the frames have measured; and a room
    that is lost in a wide, unseen surrounding, or cut off."""
    axes = plots.plot_slice(SPHERE, sequence, 0.0).axes[0]
    (veil,) = [c for c in axes.collections if c.get_gid() == "unseen"]
    # Before and just behind the surface; far behind it, behind the camera, out of view.
    x = np.array([0.03, 0.03, 0.03, 0.03, 1.5])
    z = np.array([-0.5, -1.05, -1.3, 0.5, -0.5])
    row, column = (((place + 2) / 4 * 240).round().astype(int) for place in (z, x))
    assert veil.get_array()[row, column, 3].tolist() == [0, 0, 1, 1, 1]  # bounds are [-2, 2]
    # The slice ends around what was seen.
    seen = np.flatnonzero((veil.get_array()[..., 3] == 0).any(axis=0)) / 240 * 4 - 2
    x = np.concatenate([seen, sequence.T_world_camera[:, 0, 3]])
    assert axes.get_xlim() == pytest.approx((x.min() - 0.1, x.max() + 0.1), abs=0.02)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_no_top_view_is_mirrored(axis: int, sign: int, sequence) -> None:
    """Catches rooms whose left and right are exchanged on the page."""
    up = sign * np.eye(3)[axis]
    T_true = held(sequence, tuple(up)).T_world_camera
    axes = plots.plot_overview(CLOUD, {"true": T_true}, None, "").axes[0]
    labels = axes.get_xlabel(), axes.get_ylabel()
    right, page_up = (np.eye(3)["xyz".index(label[0])] for label in labels)
    assert np.cross(right, page_up * (-1 if axes.yaxis_inverted() else 1)) == pytest.approx(up)


@pytest.mark.parametrize("inverted", [False, True])
def test_one_looks_into_the_doll_house(inverted, sequence) -> None:
    """Catches near walls or a ceiling left in the way, whichever way the faces are oriented,
    mirrored or skewed pictures, and a viewer below the floor."""
    mesh = room_mesh()
    if inverted:
        mesh.invert()
    paths = {"true": sequence.T_world_camera}
    low = trimesh.creation.box((4.0, 2.0, 0.1))  # alone it would show most from another side
    low.visual.vertex_colors = mesh.visual.vertex_colors
    room, other = plots.plot_mesh({"high": mesh, "low": low}, paths).axes
    assert len(room.collections[0].get_paths()) == 6  # triangles of the floor and two far walls
    in_room, in_other = (axes.lines[0].get_xydata() for axes in (room, other))
    assert in_room == pytest.approx(in_other)  # both are seen from one place
    screen = screen_axes(np.array([0, 0, -1]), 35.0)
    assert screen @ screen.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(screen) == pytest.approx(1)
    assert screen[2, 2] == pytest.approx(-(0.5**0.5))


def test_the_slice_has_the_projection_of_the_room(sequence, tmp_path) -> None:
    """Catches a path that is drawn elsewhere in the slice than in the room, errors in another unit,
    and a figure that cannot be printed."""
    T_tracked = sequence.T_world_camera.copy()
    T_tracked[:, :3, 3] += [0.03, 0.0, 0.04]
    paths = {"true": sequence.T_world_camera, "tracked": T_tracked}
    figure = plots.plot_map_and_slice(NEAR, sequence, paths, voxel=0.1)
    room, level, errors = figure.axes[:3]
    in_room, in_slice = (axes.lines[0].get_xydata() for axes in (room, level))
    assert in_slice == pytest.approx(in_room, abs=1e-9)
    (off_mm,) = errors.lines
    assert off_mm.get_ydata() == pytest.approx(np.full(len(sequence), 50.0))
    figure.savefig(tmp_path / "figure_1.pdf")
    assert (tmp_path / "figure_1.pdf").read_bytes().startswith(b"%PDF")


def test_poses_that_are_not_known_leave_gaps(sequence) -> None:
    """Catches a path with an unknown pose, around which no slice and no top view can be drawn."""
    T_true = sequence.T_world_camera.copy()
    T_true[2] = np.nan
    paths = {"tracked": sequence.T_world_camera, "true": T_true}
    partly_known = replace(sequence, T_world_camera=T_true)
    assert "nan" not in plots.plot_slice(NEAR, partly_known).axes[0].get_title()
    figure = plots.plot_map_and_slice(NEAR, partly_known, paths, voxel=0.1)
    assert figure.axes[1].collections[0].get_array().count() > 0  # some of the slice is seen
    (off_mm,) = figure.axes[2].lines
    assert np.flatnonzero(np.isnan(off_mm.get_ydata())).tolist() == [2]
    low = CLOUD - [0, 9, 0, 0, 0, 0]  # below the cameras
    for of_run in (paths, {"true": T_true, "tracked": sequence.T_world_camera}):
        (cloud,) = plots.plot_overview(low, of_run, None, "").axes[0].collections
        assert len(cloud.get_offsets()) > 40  # all but the outermost
    plots.plot_mesh({"room": room_mesh()}, paths)


def test_steps_begin_at_their_start(sequence) -> None:
    """Catches a path of steps in the world's axes, in another unit, also in its title, or without
    its first pose."""
    figure = FIGURES["steps"](sequence)
    plane, by_step = figure.axes[:2]
    assert plane.lines[0].get_xydata()[0] == pytest.approx([5, 0], abs=1e-6)
    errors_mm = by_step.lines[0].get_ydata()
    assert len(errors_mm) == 4
    assert errors_mm[0] == pytest.approx(50)
    assert figure.get_suptitle() == f"SDF ends {errors_mm[-1]:.0f} mm off after 3 steps"


def test_a_method_keeps_its_color() -> None:
    """Catches colours of methods that depend on the company they are in, or on a setting."""
    colors = method_colors(["new", "NeuS with SDF", "iMAP with VR", "SDF", "NeuS", "newer"])
    assert method_colors(["new", "ICP, n = 512"])["ICP, n = 512"] == method_colors(["ICP"])["ICP"]
    assert colors["NeuS with SDF"] == colors["SDF"] == colors["NeuS"]
    assert colors["new"] == method_colors(["SDF", "new"])["new"]
    assert len(set(colors.values())) == 4


def test_errors_are_those_of_their_frames() -> None:
    """Catches errors over the number of a row, and metres for centimetres."""
    line, _, still = FIGURES["errors"](None).axes[0].lines
    assert line.get_xdata() == pytest.approx([33, 36])
    assert line.get_ydata() == pytest.approx([1.0, 30.0])
    assert still.get_label() == "standing still"
    assert still.get_ydata() == pytest.approx([2.0, 4.0])


def test_unmeasured_pixels_have_no_depth(sequence) -> None:
    """Catches missing depth taken for a depth of zero, and millimetres for metres."""
    depth = plots.plot_frame(sequence, 0).axes[1].images[0].get_array()
    assert depth.mask.sum() == 1
    assert depth.compressed() == pytest.approx(1.0, abs=1e-3)


def test_a_movie_shows_every_frame(sequence) -> None:
    """Catches frames that repeat the first, a view from elsewhere, and a movie that no reader of
    images takes. A red wall is 2 m ahead of the camera; seen from behind it there is nothing."""
    wall = trimesh.creation.box(bounds=[(-4.0, -4.0, 1.95), (4.0, 4.0, 2.05)])
    wall.visual.vertex_colors = (200, 0, 0, 255)
    frames = FRAMES.iloc[:2].assign(frame_id=[3, 8], translation_error_m=[0.01, np.nan])
    poses = np.stack([np.eye(4), np.diag([-1.0, 1.0, -1.0, 1.0])])  # ahead, and turned about y
    seen = [view_of(wall, sequence.intrinsics, pose) for pose in poses]
    assert (seen[0] == (200, 0, 0)).all()
    assert (seen[1] == 255).all()
    pictures = plots.movie_pictures(wall, sequence, frames, poses, "A wall")
    with Image.open(io.BytesIO(plots.movie_bytes(pictures))) as movie:
        assert movie.n_frames == 2
        first, second = (np.asarray(i.convert("RGB")) for i in ImageSequence.Iterator(movie))
    assert not np.array_equal(first, second)


def test_sliders_move_the_camera_along_its_own_axes(sequence) -> None:
    """Catches offsets along the world's axes, in metres, and a turn about another axis."""
    T_world_moved = move_sideways(sequence[2], 10.0, 90.0).numpy()
    T_camera_moved = np.linalg.inv(sequence[2].T_world_camera) @ T_world_moved
    # A point 1 m ahead of the moved camera.
    assert T_camera_moved @ [0, 0, 1, 1] == pytest.approx([1.1, 0, 0, 1], abs=1e-6)
