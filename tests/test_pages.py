"""Notebooks as pages for a browser."""

from pathlib import Path

import nbformat

from nbtrack.experiments.bench import write_page


def test_links_and_title_of_a_page(tmp_path: Path) -> None:
    """Catches links to raw notebooks or to nowhere, and pages that all have one title."""
    text = "# 3. A title\n\nSee [next](04_next.ipynb) and [choices](../docs/choices.md)."
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_markdown_cell(text)])
    source, page = tmp_path / "notebooks/03_title.ipynb", tmp_path / "runs/pages/03_title.html"
    for folder in (source.parent, page.parent, tmp_path / "docs"):
        folder.mkdir(parents=True)
    (tmp_path / "docs/choices.md").touch()
    write_page(notebook, source, page)
    found = page.read_text()
    assert 'href="04_next.html"' in found
    assert 'href="../../notebooks/../docs/choices.md"' in found
    assert "<title>3. A title</title>" in found
