"""Notebooks as pages for a browser."""

from pathlib import Path

import nbformat

from nbtrack.experiments.bench import write_page


def test_a_page_needs_no_network(tmp_path: Path) -> None:
    """Catches formulas that only a script from elsewhere would show, dollars within code that are
    taken for formulas, links to raw notebooks or to nowhere, and pages that all have one title."""
    text = "# 3. A title\n\nWhere $x^2$ and `cost $5 or $6`:\n\n$$\\tilde d_k$$\n\n"
    text += "See [next](04_next.ipynb) and [choices](../docs/choices.md)."
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_markdown_cell(text)])
    source, page = tmp_path / "notebooks/03_title.ipynb", tmp_path / "runs/pages/03_title.html"
    for folder in (source.parent, page.parent, tmp_path / "docs"):
        folder.mkdir(parents=True)
    (tmp_path / "docs/choices.md").touch()
    write_page(notebook, source, page)
    found = page.read_text()
    assert found.count("<math") == 2
    assert "<msup>" in found
    assert "cost $5 or $6" in found
    assert 'href="04_next.html"' in found
    assert 'href="../../docs/choices.md"' in found
    assert "<title>3. A title</title>" in found
    assert '<a href="03_title.html">03 title</a>' in (page.parent / "index.html").read_text()
