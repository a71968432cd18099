"""Documents: tables and answers are those that the committed CSV files and the code give, and what
the glossary names is there.

And pages of notebooks and texts: whole without a network, with right formulas and living links.
"""

import doctest
import pydoc
import re
import runpy
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import bs4
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import documents
import evidence


def test_tables_are_those_of_the_files() -> None:
    """Catches a number in a document that no committed file says, and a table that nobody shows."""
    texts = [path.read_text() for path in documents.DOCUMENTS]
    for text in texts:
        assert documents.written(text) == text, "run python benchmarks/documents.py"
    assert all(f"<!-- table: {name} -->" in "".join(texts) for name in documents.TABLES)


@pytest.mark.parametrize("name", [n for n, grid in evidence.GRIDS.items() if grid.has_table])
def test_committed_tables_are_those_of_their_runs(name: str, tmp_path: Path) -> None:
    """Catches a table of two sensors or paths, and a caption that the code no longer writes."""
    committed, folder = documents.PROJECT / "paper_tables" / name, tmp_path / name
    folder.mkdir()
    runs = shutil.copy(committed / "table_1_cells.csv", folder)
    evidence.table_of(evidence.GRIDS[name], Path(runs))
    for file in ("table_1.csv", "table_1.tex", "table_1_vs_paper.csv"):
        assert (folder / file).read_text() == (committed / file).read_text()


def test_the_exercises_have_the_answers_of_the_code() -> None:
    """Catches an answer that the code no longer gives."""
    path = documents.PROJECT / "docs/exercises.md"
    failed, tried = doctest.testfile(str(path), module_relative=False)
    assert failed == 0 < 10 < tried


TEXT = Path(__file__).parents[1].joinpath("docs/notation.md").read_text(encoding="utf-8")
NAMES = sorted(set(re.findall(r"`(nbtrack\.[\w.]+)`", TEXT)))


@pytest.mark.parametrize("name", NAMES)
def test_names_exist(name: str) -> None:
    """Catches a name that was renamed in the code and not in the glossary."""
    found = pydoc.locate(name)
    assert found is not None
    assert found.__doc__


FIRST = documents.PROJECT / "notebooks/01_map_imap.ipynb"


@pytest.fixture(scope="module")
def pages(tmp_path_factory) -> dict[Path, bs4.BeautifulSoup]:
    """The pages of the first notebook, with stored outputs, and of the texts that it names."""
    # Here, since it takes seconds to import.
    made = SimpleNamespace(**runpy.run_path(str(documents.PROJECT / "environment/pages.py")))

    def read_source(path: Path, execute: bool):
        notebook = made.read_source(path, execute)
        if path != FIRST:
            notebook.cells = [cell for cell in notebook.cells if cell.cell_type == "markdown"]
        return notebook

    folder = tmp_path_factory.mktemp("pages")
    with mock.patch.dict(made.write_pages.__globals__, read_source=read_source):
        made.write_pages(folder, [FIRST], execute=False)
    texts = {path: path.read_text(encoding="utf-8") for path in folder.rglob("*.html")}
    return {path: bs4.BeautifulSoup(text, "html.parser") for path, text in texts.items()}


def test_links_lead_somewhere(pages: dict[Path, bs4.BeautifulSoup]) -> None:
    """Catches a link to a text or a notebook that has no page, and a missing picture or heading."""
    assert {"01_map_imap.html", "07_corrected_map.html", "choices.html"} <= {p.name for p in pages}
    for path, page in pages.items():
        for tag in page.select("a[href], img[src]"):
            url, _, heading = (tag.get("href") or tag["src"]).partition("#")
            if url.startswith(("http", "data:")):
                continue
            assert not url or (path.parent / url).is_file(), (path, url)
            if heading:
                target = pages[(path.parent / url).resolve()] if url else page
                assert target.find(id=heading), (path, url, heading)


def test_a_page_loads_nothing_and_tells_what_it_is(pages: dict[Path, bs4.BeautifulSoup]) -> None:
    """Catches a script, a style sheet or an image from the network, a page without a language or a
    title, a picture without a description, and a slider that cannot slide."""
    (page,) = (page for path, page in pages.items() if path.stem == FIRST.stem)
    assert not page.select("script, link, img[src^=http]")
    assert page.html["lang"] == "en"
    assert page.select("meta[name=viewport]")
    assert page.title.text.startswith("1. Map known rooms")
    assert not page.select("img[alt^='No description'], img[alt='']")
    assert "interactive(" not in page.text
