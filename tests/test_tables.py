"""Both tables: every published cell with its mark-up, the rules on data of our own, the files."""

import re
import shutil
import subprocess
from pathlib import Path

import pandas as pd
import pytest

from nbtrack.core.errors import DataError, MissingError
from nbtrack.core.paths import PAPER_TABLES, PROJECT_ROOT
from nbtrack.tables.comparison import (
    beside_published,
    compare_table_1,
    compare_table_2,
    summarize_table_1,
    write_comparisons,
)
from nbtrack.tables.latex import (
    TableNotes,
    escape_latex,
    latex_table_1,
    latex_table_2,
    write_published,
    write_tables,
)
from nbtrack.tables.layout import (
    COLUMNS_1,
    COLUMNS_2,
    average_over_seeds,
    best_cells,
    deviations_1,
    deviations_2,
    error_texts,
    failed_cells,
    long_form,
    published_table_1,
    published_table_2,
    read_table,
    step_texts,
    table_1,
    table_2,
)
from nbtrack.tables.styles import style_table_1, style_table_2

PAPER_SOURCE = PROJECT_ROOT / ".." / "shared" / "reference" / "paper.tex"

# Table I of the paper: value, "b" for bold, "r" for red.
PAPER_TABLE_1 = {
    (10, "iMAP with VR"): "1.575r 2.171r 0.702r 0.156b 2.196r 0.107b 3.582r 0.312r 2.744r",
    (10, "NeuS with SDF"): "0.096b 0.118b 0.215rb 0.255r 0.110b 0.114 0.052b 0.031b 0.067b",
    (5, "iMAP with VR"): "0.082 0.105 0.048b 0.032b 1.313r 0.027b 3.868r 0.035 0.080",
    (5, "NeuS with SDF"): "0.043b 0.049b 0.100 0.072 0.044b 0.073 0.045b 0.017b 0.022b",
    (2, "iMAP with VR"): "0.021b 0.020b 0.015b 0.077 0.077b 0.007b 3.987r 0.012b 0.022",
    (2, "NeuS with SDF"): "0.038 0.038 0.067 0.043b 1.148r 0.067 0.044b 0.014 0.015b",
}
PAPER_SCENES = [
    "Breakfast", "Compl. Kitchen", "Green Room", "Grey-white", "Kitchen", "Morning Apart.",
    "Staircase", "Thin Geo.", "Whiteroom",
]  # fmt: skip
# Table II of the paper: the bold n carry a "b".
PAPER_TABLE_2 = [
    ("VR", ["128", "3.2", "6.6", "36.2"]),
    ("VR", ["512b", "3.2", "6.8", "36.1"]),
    ("VR", ["1024", "2.2", "5.0", "27.0"]),
    ("SDF", ["2048", "7", "15", "77"]),
    ("SDF", ["4096b", "7.1", "15.3", "79.3"]),
    ("SDF", ["16384", "5.6", "12.7", "65.8"]),
]


def cells_1(rows: list[tuple]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=COLUMNS_1)


OURS_1 = cells_1(
    [
        (5, "A", "room_b", 0.10), (5, "B", "room_b", 0.20), (5, "C", "room_b", 0.05),
        (10, "A", "room_b", 0.3001), (10, "B", "room_b", 0.3004), (10, "A", "room_a", 0.2),
    ]
)  # fmt: skip
OURS_2 = pd.DataFrame(
    [("LM", 64, 100, 3.04), ("LM", 64, 50, 1.0), ("VR", 512, 50, 2.0), ("VR", 16, 50, 4.0)],
    columns=COLUMNS_2,
)
NOTES = TableNotes("smoke", "the paper's step counts", "CPU_1 & 50%")


def tabular_rows(source: str) -> list[list[str]]:
    """The cells of each tabular line of LaTeX source, without comments and rules."""
    text = "\n".join(line for line in source.splitlines() if not line.lstrip().startswith("%"))
    text = re.sub(r"\\begin\{tabular\}\{@\{\}r@\{\}\}(.*?)\\end\{tabular\}", _unstack, text)
    body = re.search(r"\\toprule(.*)\\bottomrule", text, re.DOTALL).group(1)
    lines = body.replace(r"\midrule", "").split(r"\\")
    return [[cell.strip() for cell in line.split("&")] for line in lines if line.strip()]


def _unstack(match: re.Match) -> str:
    return match.group(1).replace(r"\\", " ")


def marked(cell: str) -> str:
    """A LaTeX cell as in PAPER_TABLE_1: the value as printed, then r if red, then b if bold."""
    number = re.search(r"\d+(\.\d+)?", cell).group()
    red = "r" if r"\color{red}" in cell else ""
    return number + red + ("b" if r"\mathbf" in cell else "")


def check_table_1(source: str) -> None:
    head, *rows = tabular_rows(source)
    assert head[2:] == PAPER_SCENES
    assert len(rows) == len(PAPER_TABLE_1)
    for index, ((rate, method), expected) in enumerate(PAPER_TABLE_1.items()):
        group = rf"\multirow{{2}}{{*}}{{$r=\SI{{{rate}}}{{Hz}}$}}" if index % 2 == 0 else ""
        assert rows[index][:2] == [group, method]
        assert [marked(cell) for cell in rows[index][2:]] == expected.split(), (rate, method)


def check_table_2(source: str) -> None:
    head, *rows = tabular_rows(source)
    assert head == ["", "$n$", r"\SI{50}{ms}", r"\SI{100}{ms}", r"\SI{500}{ms}"]
    assert len(rows) == len(PAPER_TABLE_2)
    for index, (tracker, expected) in enumerate(PAPER_TABLE_2):
        group = rf"\multirow{{3}}{{*}}{{{tracker}}}" if index % 3 == 0 else ""
        assert rows[index][0] == group
        assert [marked(cell) for cell in rows[index][1:]] == expected


def paper_tabulars() -> list[str]:
    if not PAPER_SOURCE.is_file():
        pytest.skip("the paper's LaTeX source is not on this machine")
    parts = PAPER_SOURCE.read_text(encoding="utf-8").split(r"\begin{tabular}")[1:]
    return [part.split(r"\end{tabular}")[0] for part in parts]


def latex_is_installed() -> bool:
    if shutil.which("pdflatex") is None or shutil.which("kpsewhich") is None:
        return False
    files = ["booktabs.sty", "geometry.sty", "multirow.sty", "siunitx.sty", "xcolor.sty"]
    return subprocess.run(["kpsewhich", *files], capture_output=True).returncode == 0


def test_published_tables_cell_by_cell() -> None:
    """Catches a mistyped published value, and a rule for bold or red that is not the paper's."""
    check_table_1(latex_table_1(table_1(published_table_1())))
    check_table_2(latex_table_2(table_2(published_table_2())))
    assert published_table_1().notna().all(axis=None)
    assert (len(published_table_1()), len(published_table_2())) == (54, 18)


def test_transcription_matches_the_paper() -> None:
    """Catches the same typing error in this file and in the CSV."""
    source_1, source_2 = paper_tabulars()
    check_table_1(source_1)
    check_table_2(source_2)


def test_red_and_bold_together() -> None:
    """Catches mark-up where one of the two hides the other."""
    text = latex_table_1(table_1(published_table_1()))
    assert r"& $\color{red} \mathbf{0.215}$ &" in text
    html = style_table_1(table_1(published_table_1())).to_html()
    assert re.search(r"row1_col2 \{\s*color: red;\s*font-weight: bold;", html)


def test_golden_files(tmp_path: Path) -> None:
    """Catches committed LaTeX that was edited by hand or not written anew."""
    for path in write_published(tmp_path):
        committed = PAPER_TABLES / "published" / path.name
        assert path.read_bytes() == committed.read_bytes(), "run write_published()"


def test_layout_of_our_own_cells() -> None:
    """Catches dropped rows: rates fall, the new method C has a row at both rates, gaps are NaN."""
    wide = table_1(OURS_1)
    assert list(wide.index) == [(r, m) for r in (10, 5) for m in "ABC"]
    assert list(wide.columns) == ["room_b", "room_a"]
    assert wide.isna().sum().sum() == 6
    assert wide.at[(5, "C"), "room_b"] == 0.05


def test_notes_tell_what_was_changed() -> None:
    """Catches a table that claims a preset whose settings were others."""
    notes = TableNotes("paper", "wall clock", "CPU", ("mapping.neus.iterations=5",))
    told = "Preset: paper, with mapping.neus.iterations=5; budget: wall clock; device: CPU."
    assert str(notes) == told
    assert r"mapping.neus.iterations=5; budget" in latex_table_1(
        table_1(OURS_1), budget_note=str(notes)
    )


def test_best_and_failed_by_hand() -> None:
    """Catches ties that only one row wins, a lone value praised, 0.2 m called a failure."""
    wide = table_1(OURS_1)
    best, failed = best_cells(wide), failed_cells(wide)
    # At 10 Hz A and B both print 0.300; at 5 Hz C wins; room_a has one value, so no comparison.
    assert list(best["room_b"]) == [True, True, False, False, False, True]
    assert not best["room_a"].any()
    assert list(failed["room_b"]) == [True, True, False, False, False, False]
    assert not failed["room_a"].any()


def test_scenes_of_the_dataset_get_the_papers_names() -> None:
    """Catches results that cannot be compared because folders and labels differ."""
    wide = table_1(cells_1([(10, "A", "grey_white_room", 0.1), (10, "A", "thin_geometry", 0.1)]))
    assert list(wide.columns) == ["Grey-white", "Thin Geo."]


def test_latex_of_our_own_cells() -> None:
    """Catches unescaped underscores, wrong row spans, missing cells that vanish."""
    text = latex_table_1(table_1(OURS_1), budget_note=str(NOTES))
    head, *rows = tabular_rows(text)
    assert head == ["", "", "room b", "room a"]
    assert rows[0][0] == r"\multirow{3}{*}{$r=\SI{10}{Hz}$}"
    assert rows[2] == ["", "C", "--", "--"]
    assert rows[5] == ["", "C", r"$\mathbf{0.050}$", "--"]
    assert text.count(r"\midrule") == 2
    assert r"budget: the paper's step counts; device: CPU\_1 \& 50\%." in text
    assert "% Preset: smoke; budget: the paper's step counts; device: CPU_1 & 50%." in text


def test_steps_of_our_own_cells() -> None:
    """Catches a sort that moves a new tracker, and whole numbers printed beside decimals."""
    wide = table_2(OURS_2)
    assert list(wide.index) == [("LM", 64), ("VR", 16), ("VR", 512)]
    assert list(wide.columns) == [50, 100]
    assert step_texts(wide).values.tolist() == [["1.0", "3.0"], ["4", "–"], ["2", "–"]]
    rows = tabular_rows(latex_table_2(wide, default_pixels={"LM": 64}))
    assert rows[1:] == [
        [r"\multirow{1}{*}{LM}", r"$\mathbf{64}$", "$1.0$", "$3.0$"],
        [r"\multirow{2}{*}{VR}", "$16$", "$4$", "--"],
        ["", "$512$", "$2$", "--"],
    ]


def test_styled_tables_are_the_same_every_time() -> None:
    """Catches random ids and memory addresses, which make notebooks differ at each run."""
    for style, wide in ((style_table_1, table_1(OURS_1)), (style_table_2, table_2(OURS_2))):
        first, second = style(wide, "Caption"), style(wide, "Caption")
        assert first.to_html() == second.to_html()
        assert "<caption>Caption</caption>" in first.to_html()
        assert repr(first) == repr(second)
        assert " at 0x" not in repr(first)
        assert "–" in first.to_html()
        assert "–" in repr(first)


def test_default_pixels_are_bold_in_html() -> None:
    """Catches emphasis lost among row labels that notebooks print in bold anyway."""
    html = style_table_2(table_2(published_table_2())).to_html()
    bold = re.search(r"([^}]*)\{\s*font-weight: bold;", html).group(1)
    assert re.findall(r"level1_row(\d)", bold) == ["1", "4"]


def test_long_form_is_the_inverse() -> None:
    """Catches values that change place between CSV and printed table."""
    pd.testing.assert_frame_equal(
        long_form(table_1(published_table_1()), "ate_m"), published_table_1()
    )
    pd.testing.assert_frame_equal(
        long_form(table_2(published_table_2()), "steps"), published_table_2()
    )


def test_comparison() -> None:
    """Catches our row beside another row's published values, or a comparison across rooms."""
    published = table_1(published_table_1())
    ours = pd.concat([published + 1, (published + 2).rename(index={"iMAP with VR": "new"})])
    ours = ours.loc[[(10, "NeuS with SDF"), (10, "new")]].iloc[[0, 2], ::-1]
    both = compare_table_1(ours, published)
    assert list(both.index) == [
        (10, "NeuS with SDF", "ours"), (10, "NeuS with SDF", "paper"),
        (10, "NeuS with SDF", "difference"), (10, "new", "ours"),
    ]  # fmt: skip
    assert both["Breakfast"].tolist() == pytest.approx([1.096, 0.096, 1.0, 3.575])
    seven = compare_table_1(published.iloc[:, :7], published)
    assert seven.shape == (18, 7)
    with pytest.raises(DataError, match=r"our scenes are office; comparable .*summarize_table_1"):
        compare_table_1(published[["Breakfast"]].set_axis(["office"], axis=1), published)


def test_summary_by_hand() -> None:
    """Catches shares over the wrong total: of 0.1, 0.3 and a failed run, two of three are lost."""
    cells = cells_1([(10, "A", "x", 0.1), (10, "A", "y", 0.3), (10, "A", "z", float("nan"))])
    summary = summarize_table_1(cells, published_table_1())
    assert summary.index.tolist() == [(10, "A")]
    assert summary.iloc[0, 0] == pytest.approx(0.2)
    assert summary.iloc[0, 2] == pytest.approx(2 / 3)
    paper = summarize_table_1(published_table_1(), published_table_1())
    assert paper.loc[(10, "iMAP with VR")].tolist() == pytest.approx([1.575, 1.575, 7 / 9, 7 / 9])


def test_comparison_of_steps(tmp_path: Path) -> None:
    """Catches steps of one n beside those of another, and files that lose the difference."""
    published = published_table_2()
    twice = published.assign(steps=2 * published["steps"])
    both = compare_table_2(table_2(twice), table_2(published))
    assert both[500].unstack("source").loc[("VR", 512)].to_dict() == pytest.approx(
        {"ours": 72.2, "paper": 36.1, "difference": 36.1}
    )
    paths = write_comparisons(tmp_path, OURS_1, twice)
    assert [path.name for path in paths] == ["table_1_vs_paper.csv", "table_2_vs_paper.csv"]
    assert "VR,512,difference,3.2,6.8,36.1" in paths[1].read_text()


def test_what_stands_beside_the_paper() -> None:
    """Catches rooms of our own compared scene by scene with the dataset's, and the reverse."""
    assert "source" in beside_published(published_table_1()).index.names
    assert "source" not in beside_published(OURS_1).index.names


def test_mean_and_deviation_over_seeds() -> None:
    """Catches a population's deviation, seeds mixed between cells, a failed seed averaged away."""
    results = pd.concat(
        [cells_1([(10, "A", "x", v), (10, "B", "x", 1.0)]) for v in (0.1, 0.2, 0.3)]
    )
    cells = average_over_seeds(results)
    assert cells["method"].tolist() == ["A", "B"]
    assert cells["ate_m"].tolist() == pytest.approx([0.2, 1.0])
    assert cells["ate_deviation_m"].tolist() == pytest.approx([0.1, 0.0])
    assert cells["seeds"].tolist() == [3, 3]
    texts = error_texts(table_1(cells), deviations_1(cells))
    assert texts["x"].tolist() == ["0.200 ± 0.100", "1.000 ± 0.000"]
    latex = latex_table_1(table_1(cells), deviation=deviations_1(cells))
    assert r"\mathbf{0.200}{\scriptscriptstyle\pm0.100}$" in latex
    results.iloc[2, results.columns.get_loc("ate_m")] = float("nan")
    assert average_over_seeds(results)["ate_m"].isna().tolist() == [True, False]


def test_one_seed_has_no_spread() -> None:
    """Catches "± nan" in every table that was made with one seed, as most are."""
    cells = average_over_seeds(OURS_1.dropna())
    assert deviations_1(cells) is None
    assert "±" not in repr(style_table_1(table_1(cells), deviation=deviations_1(cells)))


def test_spread_of_steps() -> None:
    """Catches spreads that change place between rows of Table II."""
    cells = OURS_2.assign(steps_deviation=[0.5, 1.5, 0.25, 0.75][: len(OURS_2)])
    spread = deviations_2(cells)
    assert spread.loc[("LM", 64)].tolist() == [
        cells.loc[(cells["tracker"] == "LM") & (cells["budget_ms"] == b), "steps_deviation"].item()
        for b in (50, 100)
    ]
    assert step_texts(table_2(cells), spread).loc[("LM", 64)].iloc[0].startswith("1.0 ± ")
    assert deviations_2(OURS_2) is None


def test_written_files(tmp_path: Path) -> None:
    """Catches CSV files that do not read back, gaps that are lost, files that differ each time."""
    paths = write_tables(tmp_path / "smoke", OURS_1, OURS_2, NOTES)
    names = ["table_1.csv", "table_1.tex", "table_2.csv", "table_2.tex"]
    assert [path.name for path in paths] == names
    contents = [path.read_bytes() for path in paths]
    again = write_tables(tmp_path / "smoke", OURS_1, OURS_2, NOTES)
    assert [path.read_bytes() for path in again] == contents
    pd.testing.assert_frame_equal(table_1(read_table(paths[0], COLUMNS_1)), table_1(OURS_1))
    pd.testing.assert_frame_equal(table_2(read_table(paths[2], COLUMNS_2)), table_2(OURS_2))
    assert "10,C,room_a,\n" in paths[0].read_text()
    assert r"\label{tab:ate-smoke}" in paths[1].read_text()


def test_bad_cells(tmp_path: Path) -> None:
    """Catches a table of averages or of nothing where the input is not one value per cell."""
    with pytest.raises(DataError, match=r"two rows for \(5, A, room_b\); allowed: one"):
        table_1(pd.concat([OURS_1, OURS_1]))
    with pytest.raises(DataError, match="expected at least one row with rate_hz"):
        table_1(OURS_1[:0])
    with pytest.raises(DataError, match="expected at least one row with tracker"):
        table_2(OURS_1)
    with pytest.raises(MissingError, match=r"no file .*absent\.csv; expected a table"):
        read_table(tmp_path / "absent.csv", COLUMNS_1)


def test_escape_latex() -> None:
    """Catches device and scene names that break or vanish from the document."""
    assert escape_latex(r"a_b & 5% #1 $x {y} ~ ^ \z") == (
        r"a\_b \& 5\% \#1 \$x \{y\} \textasciitilde{} \textasciicircum{} \textbackslash{}z"
    )


@pytest.mark.skipif(not latex_is_installed(), reason="no LaTeX with the packages needed")
@pytest.mark.parametrize("which", ["published", "ours"])
def test_tables_compile(tmp_path: Path, which: str) -> None:
    """Catches a table that needs more than its comment says: the document there is compiled."""
    if which == "published":
        paths = write_published(tmp_path)
    else:
        paths = write_tables(tmp_path, OURS_1, OURS_2, NOTES)
    for path in paths:
        if path.suffix != ".tex":
            continue
        comments = re.findall(r"^%   (.*)$", path.read_text(), re.MULTILINE)
        assert comments[0].startswith(r"\documentclass")
        assert len(comments) <= 20
        document = tmp_path / "document.tex"
        document.write_text("\n".join(comments) + "\n")
        command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", document.name]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=60)
        output = done.stdout.decode(errors="replace")
        assert done.returncode == 0, output[-2000:]
        assert "Overfull" not in output
