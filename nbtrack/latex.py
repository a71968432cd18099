"""Tables as LaTeX, marked up as in the paper, by the template `table.tex.jinja`."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2

_SPECIAL = {character: rf"\{character}" for character in "_&%$#{}"}
_SPECIAL |= {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_KINDS = {"table_1": "ate", "table_2": "runtime", "table_3": "beyond"}  # by a file's name
_LATEX = jinja2.Environment(
    loader=jinja2.PackageLoader("nbtrack", ""), keep_trailing_newline=True, trim_blocks=True,
    block_start_string="<%", block_end_string="%>", variable_start_string="<<",
    variable_end_string=">>", comment_start_string="<#", comment_end_string="#>",
)  # fmt: skip


@dataclass(frozen=True)
class Wording:
    """What an author's LaTeX says in place of ours."""

    caption: str | None = None  # LaTeX; empty: the usual one without the note
    label: str | None = None  # Table II beside Table I has it too, ending in `-steps`
    scenes: dict[str, str] = field(default_factory=dict)  # labels by the names in the table


OUR_WORDING = Wording()


def latex_file(styler: Any, path: Path, note: str, own: Wording = OUR_WORDING) -> str:
    """The text of the `.tex` file for `styler`, a `TableStyler` of `nbtrack.tables`.

    The name of `path`, `table_1`, `table_2` or `table_3`, chooses the caption, and its folder's
    name goes into the label; nothing is written here. `note`, plain text, tells how the numbers
    came about. An author's own caption is that of Table I or III; Table II then has the usual one
    without the note.
    """
    cells = styler.data
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
        columns=[own.scenes.get(scene, scene) for scene in cells],
        groups=groups.items(),
    )


def _plain(text: object) -> str:
    """Text with LaTeX's special characters escaped, and what reads `n = 64` set as a formula."""
    return re.sub(r"\bn = \d+", r"$\g<0>$", str(text).translate(str.maketrans(_SPECIAL)))


_LATEX.filters["plain"] = _plain
