"""Tables as LaTeX, marked up as in the paper, by the template `table.tex.jinja`."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd

_SPECIAL = {character: rf"\{character}" for character in "_&%$#{}"}
_SPECIAL |= {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
# In an author's LaTeX: what stays as it is (formulas, references, commands and escaped
# characters), or a character that is meant as text, since bare it would not compile.
_AS_IS = r"\$[^$]+\$|\\(?:\w*ref|cite\w*)\*?\{[^}]*\}|\\[a-zA-Z]+|\\[^a-zA-Z\s]"
_AUTHORS = re.compile(rf"({_AS_IS})|[%&#_^$\\]")
_COLUMN_PT = 235  # width of a column of a paper on letter paper or A4
_CHARACTER_PT, _GAP_PT = 4, 12  # of \scriptsize, and between two columns of a table
_KINDS = {"table_1": "ate", "table_2": "runtime", "table_3": "beyond"}  # by a file's name
_LATEX = jinja2.Environment(
    loader=jinja2.PackageLoader("nbtrack", ""), keep_trailing_newline=True, trim_blocks=True,
    block_start_string="<%", block_end_string="%>", variable_start_string="<<",
    variable_end_string=">>", comment_start_string="<#", comment_end_string="#>",
)  # fmt: skip


@dataclass(frozen=True)
class Wording:
    """What an author's LaTeX says in place of ours."""

    # LaTeX, in which a bare %, &, #, _, ^ or single $ is text; empty: the usual, without the note.
    caption: str | None = None
    label: str | None = None  # Table II beside Table I has it too, ending in `-steps`
    scenes: dict[str, str] = field(default_factory=dict)  # labels by the names in the table


OUR_WORDING = Wording()


def latex_file(styler: Any, path: Path, note: str, own: Wording = OUR_WORDING) -> str:
    """The text of the `.tex` file for `styler`, a `TableStyler` of `nbtrack.tables`.

    The name of `path`, `table_1`, `table_2` or `table_3`, chooses the caption, and its folder's
    name goes into the label; nothing is written here. `note`, plain text, says how the numbers were
    measured. An author's own caption is that of Table I or III; Table II then has the usual one
    without the note.
    """
    cells = styler.data
    columns = [own.scenes.get(scene, scene) for scene in cells]
    groups = {}  # the rows of a rate by method, or of a tracker by n
    for (first, second), row in zip(cells.index, cells.to_numpy(), strict=True):
        groups.setdefault(first, []).append((second, row))
    return _LATEX.get_template("table.tex.jinja").render(
        styler=styler,
        own=own,
        kind=_KINDS[path.stem],
        name=path.stem,
        folder=re.sub(r"[^\w.-]", "_", path.resolve().parent.name),  # without special characters
        note=" ".join(note.split()),
        has_steps="n_pixels" in cells.index.names,
        has_std=any(cell.std for cell in cells.to_numpy().flat),
        has_converged=any("‡" in cell.value for cell in cells.to_numpy().flat),
        columns=columns,
        is_wide=_width_pt(cells, columns) > _COLUMN_PT,
        groups=groups.items(),
    )


def _width_pt(cells: pd.DataFrame, columns: list[Any]) -> float:
    """About the width of a printed table: that of its rates and methods, and of its columns."""
    n_characters = 8 + max(len(str(second)) for _, second in cells.index)
    for name, column in zip(columns, cells, strict=True):
        words = str(name).replace("_", " ").split()  # one below another
        n_characters += max(map(len, [*words, *map(str, cells[column])]))
    return _CHARACTER_PT * n_characters + _GAP_PT * (len(columns) + 1)


def _plain(text: object) -> str:
    """Text with LaTeX's special characters escaped, and what reads `n = 64` set as a formula."""
    return re.sub(r"\bn = \d+", r"$\g<0>$", str(text).translate(str.maketrans(_SPECIAL)))


def _authors(text: str) -> str:
    """An author's LaTeX in which what is meant as text is escaped, so that it compiles."""
    text = " ".join(text.split())  # an empty line ends a caption
    braces = re.sub(r"\\.", "", text)
    if braces.count("{") != braces.count("}"):
        return _plain(text)
    escaped = _AUTHORS.sub(lambda found: found[1] or _SPECIAL[found[0]], text)
    return re.sub(r"(?<!\\)[%&#]", r"\\\g<0>", escaped)  # those of formulas


def label_of(text: str) -> str:
    """An author's label, with a hyphen in place of what no label can hold."""
    return re.sub(r"[^\w:./+ -]", "-", text)  # other characters end a label, or TeX


_LATEX.filters |= {"plain": _plain, "authors": _authors, "label": label_of}
