"""Both tables: every published cell with its mark-up, the rules on data of our own, the files."""

import re
import shutil
import subprocess
from pathlib import Path

import pandas as pd
import pytest

from nbtrack import tables
from nbtrack.experiments.runs import over_rooms, shares
from nbtrack.latex import Wording, latex_file
from nbtrack.machinery.errors import ConfigError, DataError
from nbtrack.tables import style_table_1, style_table_2, table_1, table_2, write_tables

PROJECT = Path(__file__).parent.parent
PAPER_SOURCE = PROJECT / ".." / "shared" / "reference" / "paper.tex"

PUBLISHED_1, PUBLISHED_2 = tables.published_table_1(), tables.published_table_2()
COLUMNS_1 = ["rate_hz", "method", "scene", "ate_m"]
OURS_1 = pd.DataFrame(
    [
        (5, "A", "room_b", 0.10), (5, "B", "room_b", 0.20), (5, "C", "room_b", 0.05),
        (10, "A", "room_b", 0.3001), (10, "B", "room_b", 0.3004), (10, "A", "room_a", 0.2),
    ], columns=COLUMNS_1,
)  # fmt: skip
OURS_2 = pd.DataFrame(
    [("LM", 64, 100, 3.04), ("LM", 64, 50, 1.0), ("VR", 512, 50, 2.0), ("VR", 16, 50, 4.0)],
    columns=["tracker", "n_pixels", "budget_ms", "steps"],
)
SEEDS = pd.DataFrame(
    [(10, m, "x", v, s) for s, v in enumerate((0.1, 0.2, 0.3)) for m, v in (("A", v), ("B", 1.0))],
    columns=[*COLUMNS_1, "seed"],
)
NOTE = r"Preset: smoke; budget: the paper's step counts; device: CPU_1 & 50% #1 $x {y} ~ ^ \z."
ESCAPED = r"CPU\_1 \& 50\% \#1 \$x \{y\} \textasciitilde{} \textasciicircum{} \textbackslash{}z.}"


def shown(styler) -> list[list[str]]:
    """The texts in the table's cells."""
    return styler.data.map(str).values.tolist()


def latex(styler) -> str:
    return latex_file(styler, Path("smoke/table_1.tex"), NOTE)


def tabular_rows(source: str) -> list[list[str]]:
    """The cells of each tabular line of LaTeX source, without comments and rules."""
    text = "\n".join(line for line in source.splitlines() if not line.lstrip().startswith("%"))
    stacked = r"\\begin\{tabular\}\{@\{\}r@\{\}\}(.*?)\\end\{tabular\}"
    text = re.sub(stacked, lambda match: match.group(1).replace(r"\\", " "), text)
    body = re.search(r"\\toprule(.*)\\bottomrule", text, re.DOTALL).group(1)
    lines = body.replace(r"\midrule", "").replace("[c]", "").split(r"\\")
    return [[cell.strip() for cell in line.split("&")] for line in lines if line.strip()]


def marked_rows(source: str) -> list[list[str]]:
    """The table in LaTeX source: each number as printed, then r if red, then b if bold."""
    head, *rows = tabular_rows(source)
    return [head[2:], *([row[0], *map(_marked, row[1:])] for row in rows)]


def _marked(cell: str) -> str:
    number = re.search(r"\d+(\.\d+)?", cell)
    if not number:
        return cell
    is_bold = r"\mathbf" in cell or r"\bfseries" in cell
    return number.group() + "r" * (r"\color{red}" in cell) + "b" * is_bold


@pytest.mark.parametrize("number", [1, 2])
def test_published_tables_cell_by_cell(number: int, tmp_path: Path) -> None:
    """Catches a mistyped published value, a rule for bold or red that is not the paper's, and a
    committed table that was edited by hand."""
    note = "Values as published by Bruns, Zangeneh and Jensfelt."
    write_tables(tmp_path / "published", PUBLISHED_1, PUBLISHED_2, note)
    name = f"published/table_{number}.tex"
    written = (tmp_path / name).read_text(encoding="utf-8")
    assert written == (PROJECT / "paper_tables" / name).read_text(encoding="utf-8")
    if PAPER_SOURCE.is_file():
        paper = PAPER_SOURCE.read_text(encoding="utf-8").split(r"\begin{tabular}")[number]
        assert marked_rows(paper.split(r"\end{tabular}")[0]) == marked_rows(written)


def test_marks_stand_without_the_style_sheet() -> None:
    """Catches marks that only a style sheet holds, which pages drop that do not trust a notebook,
    mark-up where one hides the other, and signs that no caption explains."""
    styler = style_table_1(PUBLISHED_1, "Caption")
    assert r"& \color{red} \bfseries 0.215\rlap{$^\dagger$} &" in latex(styler)
    style, html = styler.to_html().split("</style>")
    assert re.search(r"row1_col2 \{\s*color: red;\s*font-weight: bold;", style)
    cells = [
        re.sub("<b>(.*)</b>", r"\1b", cell).replace(" †b", "rb").replace(" †", "r")
        for cell in re.findall(r"<td [^>]*>(.*?)</td>", html)
    ]
    assert cells == [cell for row in marked_rows(latex(styler))[1:] for cell in row[2:]]
    legend = "bold: best at this rate; † and red: above 0.2 m"
    assert f"<caption>Caption; {legend}</caption>" in html
    assert f"<caption>{legend}</caption>" in style_table_1(OURS_1).to_html()
    html = style_table_2(PUBLISHED_2).to_html().split("</style>")[1]
    labels = re.findall(r'<th [^>]*class="row_heading level1[^>]*>(.*?)</th>', html)
    assert labels == ["128", "<b>512 *</b>", "1024", "2048", "<b>4096 *</b>", "16384"]
    assert "<caption>* and bold: the n used for tracking</caption>" in html


def test_styled_tables_are_the_same_every_time() -> None:
    """Catches random ids and memory addresses, which make notebooks differ at each run, and ids
    that tables share: on one page the style sheets of all of them then colour each."""

    def styled() -> list:
        errors = [style_table_1(OURS_1), style_table_1(OURS_1, "A"), style_table_1(OURS_1[1:])]
        return errors + [style_table_2(OURS_2, default_pixels={"LM": n}) for n in (64, 65)]

    first, second = styled(), styled()
    latex(first[0])  # must not change what the notebook shows
    pages = [table.to_html() for table in first]
    assert pages == [table.to_html() for table in second]
    assert [*map(repr, first)] == [*map(repr, second)]
    assert " at 0x" not in repr(first)
    assert len({re.search(r'<table id="T_(.*?)"', page)[1] for page in pages}) == len(first)


def test_marks_and_gaps_by_hand() -> None:
    """Catches ties that only one row wins, a lone value praised, 0.2 m called a failure, missing
    cells and rows that vanish, rates that do not fall, wrong row spans, unescaped underscores."""
    text = latex(style_table_1(OURS_1))
    head, *rows = tabular_rows(text)
    assert head == ["", "", "room b", "room a"]
    # At 10 Hz A and B both print 0.300; at 5 Hz C wins; room_a has one value, so no comparison.
    both = r"\color{red} \bfseries 0.300\rlap{$^\dagger$}"
    assert rows == [
        [r"\multirow{3}{*}{$r=\SI{10}{Hz}$}", "A", both, "0.200"],
        ["", "B", both, "--"],
        ["", "C", "--", "--"],
        [r"\multirow{3}{*}{$r=\SI{5}{Hz}$}", "A", "0.100", "--"],
        ["", "B", "0.200", "--"],
        ["", "C", r"\bfseries 0.050", "--"],
    ]
    assert text.count(r"\midrule") == 2
    assert "best at this rate). Preset: smoke; budget: the paper's step counts; device: " in text
    assert ESCAPED in text
    assert f"% {NOTE}\n" in text
    named = OURS_1.replace({"room_a": "grey_white_room", "room_b": "thin_geometry"})
    assert list(table_1(named).columns) == ["Thin Geo.", "Grey-white"]


def test_steps_of_our_own_cells() -> None:
    """Catches a sort that moves a new tracker, whole numbers printed beside decimals, and spreads
    that change place between rows."""
    assert list(table_2(OURS_2).index) == [("LM", 64), ("VR", 16), ("VR", 512)]
    assert list(table_2(OURS_2).columns) == [50, 100]
    styler = style_table_2(OURS_2, default_pixels={"LM": 64})
    assert shown(styler) == [["1.0", "3.0"], ["4", "–"], ["2", "–"]]
    assert tabular_rows(latex(styler))[1:] == [
        ["LM", r"\bfseries 64", "1.0", "3.0"],
        [r"\multirow{2}{*}{VR}", "16", "4", "--"],
        ["", "512", "2", "--"],
    ]
    ended = style_table_2(OURS_2.assign(converged=OURS_2["tracker"] == "LM"))
    assert shown(ended) == [["1.0‡", "3.0‡"], ["4", "–"], ["2", "–"]]
    assert r"& 1.0\rlap{$^\ddagger$} & 3.0" in latex(ended)
    assert "until it converged" in ended.caption
    spread = style_table_2(OURS_2.assign(steps_std=[0.5, 1.5, 0.25, 0.75]))
    assert shown(spread)[:2] == [["1.0 ± 1.5", "3.0 ± 0.5"], ["4.0 ± 0.8", "–"]]


def test_mean_and_deviation_over_seeds() -> None:
    """Catches a population's deviation, seeds mixed between cells, a failed seed averaged away."""
    cells = tables.average_over_seeds(SEEDS)
    assert cells["method"].tolist() == ["A", "B"]
    assert cells["ate_m"].tolist() == pytest.approx([0.2, 1.0])
    assert cells["ate_std_m"].tolist() == pytest.approx([0.1, 0.0])
    styler = style_table_1(SEEDS)
    assert shown(styler) == [["0.200 ± 0.100"], ["1.000 ± 0.000"]]
    assert r"\bfseries 0.200$_{\pm0.100}$" in latex(styler)
    assert "Small: std over seeds." in latex(styler)
    failed = SEEDS.assign(ate_m=[0.1, 1.0, None, 1.0, 0.3, 1.0])
    assert tables.average_over_seeds(failed)["ate_m"].isna().tolist() == [True, False]
    assert shown(style_table_1(failed)) == [["–"], ["1.000 ± 0.000"]]
    assert "±" not in repr(style_table_1(OURS_1))


def test_standing_still_is_a_row() -> None:
    """Catches a table without the dullest alternative, one row of it for each method, a std over
    seeds of what no seed changes, or one in the published table, where nobody knows it."""
    still = SEEDS.assign(still_ate_m=SEEDS["method"].map({"A": 0.25, "B": 0.25}))
    assert table_1(still)["x"].tolist() == pytest.approx([0.2, 1.0, 0.25])
    assert f" & {tables.STANDING_STILL} & " in latex(style_table_1(still))
    assert shown(style_table_1(still)) == [["0.200 ± 0.100"], ["1.000 ± 0.000"], ["0.250"]]
    assert tables.STANDING_STILL not in table_1(PUBLISHED_1).index.get_level_values("method")


def test_comparison_scene_by_scene() -> None:
    """Catches our row, or our steps of one n, beside published values of another."""
    ours = PUBLISHED_1.assign(ate_m=PUBLISHED_1["ate_m"] + 1).replace({"iMAP with VR": "new"})
    ours = ours[(ours["rate_hz"] == 10) & ours["scene"].isin(["Kitchen", "Breakfast"])][::-1]
    both = tables.beside_published(ours)
    sources = [("NeuS with SDF", s) for s in ("ours", "paper", "difference")] + [("new", "ours")]
    assert list(both.index) == [(10, *source) for source in sources]
    assert list(both.columns) == ["Kitchen", "Breakfast"]
    assert both["Breakfast"].tolist() == pytest.approx([1.096, 0.096, 1.0, 2.575])
    steps = table_2(PUBLISHED_2)
    both = tables.beside(2 * steps, steps)[500]
    assert both.loc[("VR", 512)].tolist() == pytest.approx([72.2, 36.1, 36.1])


def test_comparison_of_other_rooms_by_hand() -> None:
    """Catches shares over the wrong total, or of digits that are not printed: of 0.2004,
    0.3 and a failed run two of three are lost."""
    cells = pd.DataFrame({"rate_hz": 10, "method": "A", "scene": list("xyz")})
    summary = tables.beside_published(cells.assign(ate_m=[0.2004, 0.3, float("nan")]))
    assert summary.index.tolist() == [(10, "A")]
    assert summary.iloc[0].tolist()[::2] == pytest.approx([0.2502, 2 / 3])
    renamed = PUBLISHED_1.assign(scene=lambda cells: "our " + cells["scene"])
    paper = tables.beside_published(renamed).loc[(10, "iMAP with VR")]
    assert paper.tolist() == pytest.approx([1.575, 1.575, 7 / 9, 7 / 9])


def test_written_files(tmp_path: Path) -> None:
    """Catches CSV files that do not read back, gaps that are lost, files that differ each time."""
    ours = pd.concat([OURS_1, pd.DataFrame([(10, "C", "room_a", None)], columns=COLUMNS_1)])
    paths = write_tables(tmp_path / "smoke", ours, OURS_2, NOTE, steps_note="By the clock.")
    endings = [".csv", ".tex", "_vs_paper.csv"]
    names = [f"table_{number}{ending}" for ending in endings for number in (1, 2)]
    assert sorted(path.name for path in paths) == sorted(names)
    contents = [path.read_bytes() for path in paths]
    again = write_tables(tmp_path / "smoke", ours, OURS_2, NOTE, steps_note="By the clock.")
    assert [path.read_bytes() for path in again] == contents
    pd.testing.assert_frame_equal(table_1(pd.read_csv(paths[0])), table_1(ours))
    pd.testing.assert_frame_equal(table_2(pd.read_csv(paths[3])), table_2(OURS_2))
    assert "10,C,room_a,\n" in paths[0].read_text()
    assert r"\label{tab:ate-smoke}" in paths[1].read_text()
    assert [path.name for path in paths if "By the clock." in path.read_text()] == ["table_2.tex"]
    _, third = tables.write_table_3(tmp_path / "smoke", ours.assign(n_pixels=512), NOTE)
    assert r"\label{tab:beyond-smoke}" in third.read_text()
    assert "C, $n = 512$ &" in third.read_text()


CAPTIONS = pd.read_csv(Path(__file__).parent / "data/captions.csv")


@pytest.mark.parametrize(("given", "written"), CAPTIONS.to_numpy())
def test_captions_compile(tmp_path: Path, given: str, written: str) -> None:
    """Catches a caption or label that ends a line, a cell or TeX, and LaTeX that is spoiled."""
    first, *_ = write_tables(tmp_path, OURS_1, OURS_2, NOTE, wording=Wording(given, "tab:a_b%c#1"))
    text = first.with_suffix(".tex").read_text()
    assert rf"\caption{{{written} \textcolor{{red}}" in text
    assert r"\label{tab:a_b-c-1}" in text
    assert r"\label{tab:a_b-c-1-steps}" in (tmp_path / "table_2.tex").read_text()


def test_millimetres_where_metres_tie(tmp_path: Path) -> None:
    """Catches rows that tie in metres, marks that follow another unit than the digits, a caption
    that names the wrong one, a mark that black and white printing loses, and n named twice."""
    ate_m = [0.00141, 0.00062, 0.2004, 0.20006]
    cells = pd.DataFrame({"rate_hz": 10, "method": ["ICP, 64", "LM"] * 2, "ate_m": ate_m})
    cells = cells.assign(scene=["a", "a", "b", "b"], n_pixels=64)
    styler = style_table_1(tables.naming_points(cells), unit="mm")
    assert shown(styler) == [["1.4", "200.4"], ["0.6", "200.1"]]
    assert r"1000.0$^\dagger_{\pm0.0}$ \\" in latex(style_table_1(SEEDS, unit="mm"))
    _, path = tables.write_table_3(tmp_path, cells, NOTE)
    _, icp, lm = tabular_rows(text := path.read_text())
    assert icp[1:] == ["ICP, $n = 64$", "1.4", r"\color{red} 200.4\rlap{$^\dagger$}"]
    assert lm[2:] == [r"\bfseries 0.6", r"\color{red} \bfseries 200.1\rlap{$^\dagger$}"]
    assert r"trajectory error in \si{mm} (\textcolor{red}{red}$^\dagger$: above" in text
    with pytest.raises(ConfigError, match="unknown unit 'cm'"):
        style_table_1(cells, unit="cm")


def test_means_over_rooms_and_shares_of_rows() -> None:
    """Catches a room that counts twice because it has two seeds, or once without a number, and
    wrong intervals: those that leave 0 to 100 % or have no width where nothing is lost.

    By hand: 4 cm in one room (2 and 8 with two seeds), 1 cm in the other: the mean is 2 cm, and the
    interval 12.7 standard errors of ln 2 either way, for one degree of freedom. With z = 1.96:
    z²/(10 + z²) of 0 in 10, and 1/2 ± z √(2.5 + z²/4)/(10 + z²) of 5 in 10.
    """
    rows = {"scene": [*"aabc"], "seed": [0, 1, 0, 0], "ate_m": [0.02, 0.08, 0.01, None]}
    rows["method"] = "A"
    (found,) = over_rooms(pd.DataFrame(rows), ["method"]).itertuples(index=False)
    assert found[:2] == ("A", pytest.approx(0.02))
    assert found[2:] == pytest.approx((0.02 / 2**12.7062, 0.02 * 2**12.7062), rel=1e-3)
    results = pd.DataFrame({"method": ["A"] * 10 + ["B"] * 10, "lost": [False] * 15 + [True] * 5})
    never, half = shares(results, ["method"], "lost").itertuples(index=False)
    assert (never[:2], half[:2], never[-2:]) == (("A", 0), ("B", 50), (0, 10))
    assert [*never[2:4], *half[2:4]] == pytest.approx([0, 27.75, 23.66, 76.34], abs=0.01)


def test_cells_of_no_table() -> None:
    """Catches a table of averages where the input is not one value per cell, and a KeyError for a
    table without rows, which has no columns either."""
    for make, cells, says in (
        (table_1, OURS_1, "5, A, room_b"), (table_1, SEEDS, "10, A, x, 0"),
        (table_2, OURS_2, "LM, 64, 100"),
    ):  # fmt: skip
        with pytest.raises(DataError, match=rf"two rows for \({says}\); allowed"):
            make(pd.concat([cells, cells]))
        with pytest.raises(DataError, match="it needs"):
            make(pd.DataFrame())


def latex_is_installed() -> bool:
    files = ["booktabs.sty", "geometry.sty", "multirow.sty", "siunitx.sty", "xcolor.sty"]
    has_both = shutil.which("pdflatex") and shutil.which("kpsewhich")
    return has_both and not subprocess.run(["kpsewhich", *files], capture_output=True).returncode


@pytest.mark.skipif(not latex_is_installed(), reason="no LaTeX with the packages needed")
def test_tables_compile(tmp_path: Path) -> None:
    """Catches a table that needs more than its comment says: the document there is compiled."""
    paths = write_tables(tmp_path, SEEDS, OURS_2.assign(steps_std=0.5), NOTE)
    paths += tables.write_table_1(tmp_path / "9", PUBLISHED_1.assign(still_ate_m=0.5), NOTE)
    for path in (p for p in paths if p.suffix == ".tex"):
        comments = re.findall(r"^%   (.*)$", path.read_text(), re.MULTILINE)
        (path.parent / "document.tex").write_text("\n".join(comments) + "\n")
        command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "document.tex"]
        done = subprocess.run(command, cwd=path.parent, capture_output=True, timeout=60)
        output = done.stdout.decode(errors="replace")
        assert done.returncode == 0, output[-2000:]
        assert "Overfull" not in output


def test_names_are_text_on_a_page_and_in_latex(tmp_path: Path) -> None:
    """Catches markup in the name of a recording that a page runs, and a folder's name that ends a
    label of LaTeX."""
    cells = [{"rate_hz": 10, "method": "<b>m</b>", "scene": "<script>x</script>", "ate_m": 0.1}]
    page = style_table_1(pd.DataFrame(cells), caption="<i>caption</i>").to_html()
    assert not [tag for tag in ("<script>", "<b>m", "<i>") if tag in page]
    (tmp_path / "a%b").mkdir()
    paths = tables.write_table_1(tmp_path / "a%b", pd.DataFrame(cells), "a note")
    (latex,) = [path.read_text() for path in paths if path.suffix == ".tex"]
    assert r"\label{tab:ate-a_b}" in latex
