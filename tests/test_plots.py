"""Figures: every axis has its unit, every line lies where the data are, nothing leaks."""

from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import torch
import trimesh
from matplotlib.axis import Axis
from matplotlib.figure import Figure

from nbtrack import plots
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.core.errors import DataError
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import LearnedField
from nbtrack.fields.views import View
from nbtrack.plots.doll_house import screen_axes
from nbtrack.plots.style import path_colors
from nbtrack.plots.top_view import TopView
from nbtrack.plots.training import loss_terms, running_median
from nbtrack.synthetic import Room, build_room
from nbtrack.tables.layout import published_table_1, published_table_2

RADIUS = 1.5  # m


class AnalyticField(LearnedField):
    """A field without a network."""

    name, label = "analytic", "Analytic"

    def __init__(self, bounds: SceneBounds) -> None:
        super().__init__(bounds)
        self.unused = torch.nn.Parameter(torch.zeros(1))  # says on which device the field lives

    def value(self, points_world: torch.Tensor) -> torch.Tensor:
        """Distance to a hollow sphere around the origin, positive inside."""
        return RADIUS - points_world.norm(dim=-1)

    def forward(self, points_world: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.full_like(points_world, 0.5), self.value(points_world)

    def composite(self, colors, values, rays, depths):
        raise NotImplementedError

    def mapping_losses(self, batch, config, generator):
        raise NotImplementedError

    @property
    def surface_level(self) -> float:
        return 0.0


class DensityField(AnalyticField):
    """A density (1/m) that rises through 20 at the sphere."""

    def value(self, points_world: torch.Tensor) -> torch.Tensor:
        return 20 * torch.exp(-5 * super().value(points_world))

    @property
    def surface_level(self) -> float:
        return 20.0


class RoomField(AnalyticField):
    """The exact distance of a synthetic room."""

    def __init__(self, room: Room) -> None:
        low, high = room.bounds
        super().__init__(SceneBounds(tuple((low - 0.1).tolist()), tuple((high + 0.1).tolist())))
        self.room = room

    def value(self, points_world: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(self.room.sdf(points_world.double().numpy())).float()


@pytest.fixture
def sphere() -> AnalyticField:
    return AnalyticField(SceneBounds((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0)))


@pytest.fixture
def sequence() -> RgbdSequence:
    """Six frames from the origin along +z, everything at 1 m but one pixel without depth."""
    n, height, width = 6, 12, 16
    colors = np.random.default_rng(0).integers(0, 256, (n, height, width, 3), dtype=np.uint8)
    depths_mm = np.full((n, height, width), 1000, np.uint16)
    depths_mm[:, 2, 3] = 0
    T_world_camera = np.tile(np.eye(4), (n, 1, 1))
    T_world_camera[:, 0, 3] = 0.01 * np.arange(n)
    intrinsics = Intrinsics.from_focal(width, height, 12.0)
    return RgbdSequence("six", intrinsics, colors, depths_mm, T_world_camera, np.arange(n) + 30)


@pytest.fixture
def histories() -> dict[str, pd.DataFrame]:
    falling = 1 / (1 + np.arange(40.0))
    imap = pd.DataFrame({"depth": falling, "color": falling, "total": 2 * falling})
    neus = imap.assign(eikonal=falling, deviation_m=0.05 * falling)
    return {"iMAP": imap, "NeuS": neus[["depth", "color", "eikonal", "total", "deviation_m"]]}


@pytest.fixture
def frames() -> dict[str, pd.DataFrame]:
    columns = {"frame_id": [30, 33, 36], "translation_error_m": [0.0, 0.01, 0.3]}
    rows = pd.DataFrame(columns).assign(rotation_error_deg=[0.0, 0.1, 0.2])
    return {"iMAP with VR": rows, "NeuS with SDF": rows}


def room_mesh() -> trimesh.Trimesh:
    """A box whose faces look inwards."""
    mesh = trimesh.creation.box((4.0, 2.0, 3.0))
    mesh.invert()
    mesh.visual.vertex_colors = np.full((8, 4), 200, np.uint8)
    return mesh


def all_figures(sequence, sphere, histories, frames) -> dict[str, Figure]:
    view = View(sequence.color(0), sequence.depth(0) + np.float32(0.02))
    paths = {"NeuS with SDF": sequence.T_world_camera}
    return {
        "views": plots.plot_views(sequence, [0, 3], [view, view], "close"),
        "overview": plots.plot_room_overview(sequence, "slow"),
        "losses": plots.plot_losses(histories, "fall"),
        "deviation": plots.plot_deviation(histories["NeuS"], "sharper"),
        "slice": plots.plot_slice(sphere, sequence, 0.0, title="round"),
        "density": plots.plot_slice(DensityField(sphere.bounds), sequence, 0.0, title="round"),
        "mesh": plots.plot_mesh(room_mesh(), paths, "room"),
        "paths": plots.plot_trajectories(sequence.T_world_camera, paths, "near", room_mesh()),
        "errors": plots.plot_errors(frames, "lost"),
        "ate": plots.plot_ate_bars(published_table_1(), "rates matter"),
        "steps": plots.plot_steps(published_table_2(), published_table_2(), "cheap"),
    }


def is_labelled(axis: Axis) -> bool:
    """Whether an axis without numbers, or with a label that names a unit or what it counts."""
    shows_numbers = any(t.get_text() and t.get_visible() for t in axis.get_ticklabels())
    label = axis.label.get_text()
    return not shows_numbers or label.endswith(")") or label in COUNTED


COUNTED = ("mapping iteration", "number of frames")


def test_every_axis_has_a_unit_and_every_figure_a_title(
    sequence, sphere, histories, frames
) -> None:
    """Catches an unlabelled axis or colour bar, a lost title, a figure too large for a notebook."""
    for name, figure in all_figures(sequence, sphere, histories, frames).items():
        png = figure._repr_png_()
        assert png.startswith(b"\x89PNG"), name
        assert len(png) < 150_000, name
        assert figure.get_suptitle(), name
        for axes in figure.axes:
            if axes.axison and axes.get_visible():
                assert is_labelled(axes.xaxis), (name, axes.get_xlabel())
                assert is_labelled(axes.yaxis), (name, axes.get_ylabel())


def test_drawing_leaves_no_global_state(sequence, sphere, histories, frames) -> None:
    """Catches figures shown twice by pyplot, and a style that leaks into the user's own plots."""
    before = dict(matplotlib.rcParams)
    figures = all_figures(sequence, sphere, histories, frames)
    assert plt.get_fignums() == []
    assert dict(matplotlib.rcParams) == before
    assert " at 0x" not in repr(figures["slice"])


def contour_points(figure: Figure, gid: str) -> np.ndarray:
    (lines,) = [c for c in figure.axes[0].collections if c.get_gid() == gid]
    return np.concatenate([path.vertices for path in lines.get_paths()])


@pytest.mark.parametrize("kind", [AnalyticField, DensityField])
@pytest.mark.parametrize(("height", "up"), [(0.0, (0, 1, 0)), (0.9, (0, -1, 0)), (0.9, (0, 0, 1))])
def test_the_zero_level_lies_on_the_sphere(sphere, sequence, kind, height, up) -> None:
    """Catches swapped grid axes, a wrong height or level, and pixels off by half."""
    field = kind(sphere.bounds)
    figure = plots.plot_slice(field, sequence, height, title="circle", up=up)
    points = contour_points(figure, "invented surface")
    radii = np.linalg.norm(points, axis=1)
    assert radii == pytest.approx(np.sqrt(RADIUS**2 - height**2), abs=2e-3)


def test_the_slice_is_taken_at_its_height(sequence) -> None:
    """Catches a height along the wrong axis or with the wrong sign of up."""

    class Ramp(AnalyticField):
        def value(self, points_world: torch.Tensor) -> torch.Tensor:
            return points_world[:, 1] + 0.01 * points_world[:, 0]

    ramp = Ramp(SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)))
    for up, mean in (((0, 1, 0), 0.7), ((0, -1, 0), -0.7)):
        axes = plots.plot_slice(ramp, sequence, 0.7, up=up).axes[0]
        (values,) = [c for c in axes.collections if c.get_gid() == "values"]
        assert values.get_array().mean() == pytest.approx(mean, abs=1e-4)


def test_a_true_field_lies_on_the_true_surface(sequence) -> None:
    """Catches a field and a room drawn in different frames."""
    room = build_room("bedroom")
    figure = plots.plot_slice(RoomField(room), sequence, 0.4, room)
    for line in ("invented surface", "true surface"):
        right, ahead = contour_points(figure, line).T
        points = np.stack([right, np.full(len(right), 0.4), ahead], axis=1)
        # Between grid points, 2 cm apart, the line is straight.
        assert np.abs(room.sdf(points)).max() < 0.02


def test_the_unseen_is_pale(sphere, sequence) -> None:
    """Catches inventions shown as if measured: behind the camera, and behind what it measured."""
    axes = plots.plot_slice(sphere, sequence, 0.0).axes[0]
    (veil,) = [c for c in axes.collections if c.get_gid() == "unseen"]
    opacity = veil.get_array()[..., 3]

    def opacity_at(x: float, z: float) -> float:
        rows, columns = opacity.shape  # the bounds are [-2, 2] both ways
        return float(opacity[round((z + 2) / 4 * (rows - 1)), round((x + 2) / 4 * (columns - 1))])

    assert opacity_at(0.03, 0.5) == 0  # in front of the camera, before the surface
    assert opacity_at(0.03, 1.05) == 0  # just behind what it measured
    assert opacity_at(0.03, 1.3) > 0.5  # far behind
    assert opacity_at(0.03, -0.5) > 0.5  # behind the camera
    assert opacity_at(1.5, 0.5) > 0.5  # outside of the view
    surface = [c for c in axes.collections if c.get_gid() == "surface"]
    assert sum(len(path.vertices) for c in surface for path in c.get_paths()) == 0


@pytest.mark.parametrize(
    "up", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (-1, 0, 0), (0, -1, 0), (0, 0, -1)]
)
def test_no_top_view_is_mirrored(up) -> None:
    """Catches rooms whose left and right are exchanged on the page."""
    view = TopView.along(up)
    right, page_up = np.zeros(3), np.zeros(3)
    right[view.right], page_up[view.ahead] = 1, 1 if view.ahead_is_upwards else -1
    assert np.cross(right, page_up) == pytest.approx(np.array(up))
    axes = Figure().subplots()
    view.finish(axes)
    assert axes.yaxis_inverted() != view.ahead_is_upwards


@pytest.mark.parametrize("up", [(0, 1, 0), (0.1, -1.0, 0.2)])
@pytest.mark.parametrize("elevation_deg", [20.0, 90.0])
def test_the_doll_house_is_seen_from_above(up, elevation_deg) -> None:
    """Catches mirrored or skewed pictures, and a viewer below the floor."""
    axes = screen_axes(up, 35.0, elevation_deg)
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    upward = np.array(up) / np.linalg.norm(up)
    assert axes[2] @ upward == pytest.approx(np.sin(np.radians(elevation_deg)))
    assert axes[0] @ upward == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("inverted", [False, True])
def test_one_looks_into_the_doll_house(inverted) -> None:
    """Catches near walls or a ceiling left in the way, whichever way the faces are oriented."""
    mesh = room_mesh()
    if inverted:
        mesh.invert()
    (faces,) = plots.plot_mesh(mesh, azimuth_deg=30.0).axes[0].collections
    # Two triangles each of the floor and of the two far walls.
    assert len(faces.get_paths()) == 6


def test_the_viewer_holds_mesh_and_paths(sequence) -> None:
    """Catches paths that are lost on the way to the interactive scene."""
    scene = plots.mesh_viewer(room_mesh(), {"true": sequence.T_world_camera})
    assert len(scene.geometry) == 2
    assert scene.geometry["true"].vertices[:, 0].max() == pytest.approx(0.05)


def test_a_method_keeps_its_color() -> None:
    """Catches colours that depend on the company a method is in."""
    colors = plots.method_colors(["new", "NeuS with SDF", "iMAP with VR", "SDF", "NeuS"])
    assert colors["NeuS with SDF"] == colors["SDF"] == colors["NeuS"]
    assert colors["new"] == plots.method_colors(["SDF", "new"])["new"]
    assert len({colors["new"], colors["SDF"], colors["iMAP with VR"]}) == 3
    alone = path_colors(["true", "iMAP with VR"])
    assert alone == {"true": plots.TRUE_COLOR, "iMAP with VR": plots.TRACKED_COLOR}
    both = path_colors(["true", "iMAP with VR", "NeuS with SDF"])
    assert both["iMAP with VR"] == plots.METHOD_COLORS["iMAP with VR"]


def test_losses_show_the_terms_and_no_diagnostics(histories) -> None:
    """Catches sums or lengths drawn as losses, and a median that is shifted."""
    assert loss_terms(histories["NeuS"]) == ["depth", "color", "eikonal"]
    figure = plots.plot_losses(histories)
    assert [len(axes.lines) for axes in figure.axes] == [4, 4, 2]  # raw and median each
    values = pd.Series([1.0, 2.0, 90.0, 4.0, 5.0, 6.0])
    assert running_median(values).iloc[2] == 4.0
    with pytest.raises(DataError, match="deviation_m"):
        plots.plot_deviation(histories["iMAP"])


def test_errors_run_in_seconds_without_the_given_frame(frames) -> None:
    """Catches frame numbers taken for seconds, metres for centimetres, and a counted first row."""
    line = plots.plot_errors(frames).axes[0].lines[0]
    assert line.get_xdata() == pytest.approx([1.1, 1.2])
    assert line.get_ydata() == pytest.approx([1.0, 30.0])


def test_bars_are_the_errors_of_their_cell() -> None:
    """Catches bars in the wrong group, and a missing run drawn as a perfect one."""
    cells = pd.DataFrame({
        "rate_hz": [2.0, 10.0, 2.0], "method": ["A", "A", "B"], "scene": ["whiteroom"] * 3,
        "ate_m": [0.1, 0.4, 0.2],
    })  # fmt: skip
    (axes,) = plots.plot_ate_bars(cells).axes
    first, second = axes.containers
    assert [bar.get_height() for bar in first] == [0.4, 0.1]  # 10 Hz stands left
    assert [bar.get_height() for bar in second][1] == 0.2
    crosses = axes.lines[1]  # B has no result at 10 Hz
    assert crosses.get_xdata() == pytest.approx([0.2])
    assert axes.get_title(loc="left") == "Whiteroom"


def test_steps_stand_beside_the_published_ones() -> None:
    """Catches a tracker in the wrong panel, and our points taken for the paper's."""
    ours = published_table_2().assign(steps=lambda cells: 2 * cells["steps"])
    vr, sdf = plots.plot_steps(ours, published_table_2()).axes
    assert [axes.get_title(loc="left") for axes in (vr, sdf)] == ["VR", "SDF"]
    assert len(vr.lines) == 6
    assert vr.lines[0].get_ydata() == pytest.approx(2 * vr.lines[3].get_ydata())
    assert vr.lines[3].get_markerfacecolor() == "white"


def test_unmeasured_pixels_are_not_errors(sequence) -> None:
    """Catches missing depth taken for a depth of zero."""
    view = View(sequence.color(0), np.full((12, 16), 1.02, np.float32))
    figure = plots.plot_views(sequence, [0], [view])
    error_cm = figure.axes[4].images[0].get_array()
    assert error_cm.mask.sum() == 1
    assert error_cm.compressed() == pytest.approx(2.0, abs=1e-3)


def test_figures_can_be_saved(tmp_path: Path, histories) -> None:
    """Catches figures that only a notebook can show."""
    plots.plot_losses(histories, "fall").savefig(tmp_path / "losses.pdf")
    assert (tmp_path / "losses.pdf").stat().st_size > 1000
