"""Executed notebooks as pages for a browser that need no network for their formulas."""

import html
import os
import re
from pathlib import Path
from typing import Any

import nbformat
from latex2mathml.converter import convert
from nbconvert import HTMLExporter

from nbtrack.core.files import write_atomic

_STYLE = "<style>.jp-InputArea pre { white-space: pre-wrap; }</style>"  # long lines of code
_FORMULA = re.compile(r"\$\$(.+?)\$\$|\$([^$\n]+?)\$", re.DOTALL)
_CODE = re.compile(r"(`[^`]*`)")
_LINK = re.compile(r"\]\(([\w./-]+)\)")


def write_page(notebook: Any, source: Path, page: Path) -> None:
    """Write a notebook as HTML.

    Formulas become MathML. Links to notebooks lead to their pages, those to other files to where
    these lie beside the notebook's `source`. The page has the notebook's heading as its title.
    """
    shown = nbformat.from_dict(notebook)
    for cell in shown.cells:
        if cell.cell_type == "markdown":
            cell.source = _for_a_page(cell.source, source.parent, page.parent)
    title = notebook.cells[0].source.splitlines()[0].lstrip("# ")
    exporter = HTMLExporter(mathjax_url="")
    text, _ = exporter.from_notebook_node(shown, {"metadata": {"name": title}})
    write_atomic(page, text.replace("</head>", f"{_STYLE}</head>", 1))


def _for_a_page(text: str, source_folder: Path, page_folder: Path) -> str:
    """Markdown with formulas as MathML and links that lead somewhere; code stays as it is."""

    def formula(match: re.Match) -> str:
        kind = "block" if match[1] else "inline"
        return convert(match[1] or match[2], display=kind)

    def link(match: re.Match) -> str:
        target = match[1]
        if target.endswith(".ipynb"):
            return f"]({Path(target).with_suffix('.html')})"
        path = os.path.relpath((source_folder / target).resolve(), page_folder.resolve())
        return f"]({html.escape(path)})"

    parts = _CODE.split(_LINK.sub(link, text))
    return "".join(p if p.startswith("`") else _FORMULA.sub(formula, p) for p in parts)
