"""Writes tables as LaTeX, marked up as in the paper, with the template `table.tex.jinja`."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2

_SPECIAL = {character: rf"\{character}" for character in "_&%$#{}"}
_SPECIAL |= {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
# What stays as it is in an author's LaTeX: formulas, references, commands, escaped characters.
_AS_IS = r"\$[^$]+\$|\\\(.+?\\\)|\\(?:\w*ref|cite\w*|label|ensuremath)\*?\{[^}]*\}"
_AS_IS += r"|\\[a-zA-Z]+|\\[^a-zA-Z\s]"
# Group 1 is what stays. Without it, the match is a special character, to be escaped.
_AUTHORS = re.compile(rf"({_AS_IS})|[%&#_^$\\]")
_KINDS = {"table_1": "ate", "table_2": "runtime", "table_3": "beyond"}  # by a file's stem
_LATEX = jinja2.Environment(
    loader=jinja2.PackageLoader("nbtrack", ""), keep_trailing_newline=True, trim_blocks=True,
    block_start_string="<%", block_end_string="%>", variable_start_string="<<",
    variable_end_string=">>", comment_start_string="<#", comment_end_string="#>",
)  # fmt: skip


@dataclass(frozen=True)
class Wording:
    """An author's caption, label and scene names, which replace those of this package."""

    # LaTeX, in which a bare %, &, #, _, ^ or single $ means the character itself. None: the usual
    # caption with the note; empty: the usual caption without the note.
    caption: str | None = None
    label: str | None = None  # Table II written with Table I has this label and `-steps`
    scenes: dict[str, str] = field(default_factory=dict)  # an author's names by those in the table


OUR_WORDING = Wording()


def latex_file(styler: Any, path: Path, note: str, wording: Wording = OUR_WORDING) -> str:
    """The text of the `.tex` file for `styler`, a `TableStyler` of `nbtrack.tables`.

    Nothing is written here. The stem of `path` (`table_1`, `table_2` or `table_3`) chooses the
    caption, and its folder's name becomes part of the label. `note`, plain text, says how the
    numbers were measured. An author's caption replaces that of Table I or III; Table II then has
    the usual caption without the note.
    """
    cells = styler.data
    # Rows by rate, each with its method; in Table II by tracker, each with its n.
    groups = {}
    for (first, second), row in zip(cells.index, cells.to_numpy(), strict=True):
        groups.setdefault(first, []).append((second, row))
    return _LATEX.get_template("table.tex.jinja").render(
        styler=styler,
        wording=wording,
        kind=_KINDS[path.stem],
        name=path.stem,
        folder=re.sub(r"[^\w.-]", "_", path.resolve().parent.name),  # for a label
        note=" ".join(note.split()),
        has_steps=cells.index.names[0] == "tracker",
        has_std=any(cell.std for cell in cells.to_numpy().flat),
        has_converged=any("‡" in cell.value for cell in cells.to_numpy().flat),
        columns=list(cells),
        groups=groups.items(),
    )


def _plain(text: object) -> str:
    """Plain text as LaTeX: special characters are escaped, and `n = 64` becomes a formula."""
    return re.sub(r"\bn = \d+", r"$\g<0>$", str(text).translate(str.maketrans(_SPECIAL)))


def _authors(text: str) -> str:
    """An author's LaTeX with special characters escaped that would not compile as they are.

    Text whose braces do not match is taken as plain text.
    """
    text = " ".join(text.split())  # an empty line would end the caption
    braces = re.sub(r"\\.", "", text)
    if braces.count("{") != braces.count("}"):
        return _plain(text)
    escaped = _AUTHORS.sub(lambda found: found[1] or _SPECIAL[found[0]], text)
    return re.sub(r"(?<!\\)[%&#]", r"\\\g<0>", escaped)  # in formulas and references, too


def label_of(text: str) -> str:
    """An author's label, with a hyphen in place of each character that a label cannot hold."""
    return re.sub(r"[^\w:./+ -]", "-", text)


_LATEX.filters |= {"plain": _plain, "authors": _authors, "label": label_of}
