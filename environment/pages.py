"""Writes the notebooks, and the texts that they name, as pages that need no network.

    python environment/pages.py FOLDER [--execute]

They begin at FOLDER/index.html and show the stored outputs, or, with --execute, new ones.
"""

import argparse
import os
import re
import shutil
import sys
from pathlib import Path

import nbformat
from latex2mathml.converter import convert
from nbconvert import HTMLExporter
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath
from nbconvert.preprocessors import CellExecutionError, ExecutePreprocessor, TagRemovePreprocessor

from nbtrack import load_preset, open_scenes
from nbtrack.machinery.errors import NbtrackError

ROOT = Path(__file__).resolve().parents[1]
RED = "color: #c00000;"  # its contrast with white is 6.5, that of plain red 4.0
NEEDS_KERNEL = "remove_output"  # nbconvert's usual tag: of cells that show something to be moved


class PageRenderer(IPythonRenderer):
    """Markdown with formulas as MathML, links from page to page, and GitHub's ids of headings."""

    def block_math(self, body: str) -> str:
        """A formula in its own line."""
        return mathml(body, "block")

    def inline_math(self, body: str) -> str:
        """A formula in the text."""
        return mathml(body, "inline")

    def heading(self, text: str, level: int, **attrs) -> str:
        """A heading to which links lead."""
        name = re.sub(r"<.*?>|[^\w\s-]", "", text.lower()).replace(" ", "-")
        return super(IPythonRenderer, self).heading(text, level, id=name)

    def link(self, text: str, url: str, title: str | None = None) -> str:
        """A link, within the pages where it leads to a text or a notebook of the project."""
        return super().link(text, url if "://" in url else page_of(url), title)


def mathml(tex: str, display: str) -> str:
    """A formula, "block" or "inline". Its bars are brackets, which are not taken for operators."""
    tex = re.sub(r"(\\math\w+) (\w)", r"\1{\2}", tex)  # else no letter is bold
    plain = r'<mo stretchy="false" lspace="0" rspace="0">\1</mo>'
    return re.sub(r"<mo[^>]*>(&#x02016;|&#x0007C;)</mo>", plain, convert(tex, display=display))


def page_of(source: str) -> str:
    """The address of the page of a text or a notebook; that of another file stays."""
    return re.sub(r"\.(md|ipynb)\b", ".html", re.sub(r"README\.md\b", "index.html", source))


def read_source(path: Path, execute: bool) -> nbformat.NotebookNode:
    """A notebook, run anew if asked for, or a text as a notebook of one cell."""
    if path.suffix == ".md":
        text = path.read_text(encoding="utf-8")
        return nbformat.v4.new_notebook(cells=[nbformat.v4.new_markdown_cell(text)])
    notebook = nbformat.read(path, as_version=4)
    if execute:
        # Else each kernel warns that its port of this machine is not encrypted.
        errors_only = ["--log-level=ERROR"]
        runner = ExecutePreprocessor(timeout=None, extra_arguments=errors_only)
        runner.preprocess(notebook, {"metadata": {"path": path.parent}})
        notebook.metadata.pop("widgets", None)  # a page has no kernel that would move them
    return notebook


def html_of(notebook: nbformat.NotebookNode, index: str) -> str:
    """The page of a notebook, whose title is its first heading, beside its contents.

    `index` is the address of the first page; it is empty on that page itself.
    """
    notebook.metadata["title"] = re.search(r"^# (.+)", notebook.cells[0].source, re.M)[1]
    exporter = HTMLExporter(
        template_name="pages", extra_template_basedirs=[str(ROOT / "environment")],
        exclude_input_prompt=True, exclude_output_prompt=True,
        filters={"markdown2html": MarkdownWithMath(PageRenderer(escape=False)).render},
    )  # fmt: skip
    remover = TagRemovePreprocessor(remove_all_outputs_tags={NEEDS_KERNEL})
    exporter.register_preprocessor(remover, enabled=True)
    page = exporter.from_notebook_node(notebook)[0].replace("color: red;", RED)
    return page.replace("<main>", contents_of(page, index) + "<main>", 1)


def contents_of(page: str, index: str) -> str:
    """Links to the index and to the second-level headings of a page."""
    home = f'<a href="{index}">← All notebooks</a>' if index else ""
    links = ""
    for name, heading in re.findall(r'<h2 id="(.+?)">(.+?)</h2>', page):
        links += f'<li><a href="#{name}">{re.sub("<.*?>", "", heading)}</a></li>'
    return f'<nav aria-label="Contents">{home}<ul>{links}</ul></nav>'


def named_files(notebook: nbformat.NotebookNode, folder: Path) -> list[Path]:
    """Files that the texts of a notebook in a folder link to."""
    texts = " ".join(cell.source for cell in notebook.cells if cell.cell_type == "markdown")
    paths = [(folder / url).resolve() for url in re.findall(r"\]\(([^)#]+)", texts)]
    return [path for path in paths if path.is_file()]


def write_pages(folder: Path, sources: list[Path], execute: bool) -> None:
    """Pages of texts and notebooks, and of those that they name; other files are copied.

    Below the folder everything lies where it lies in the project.
    """
    for source in sources:  # grows on the way
        target = folder / page_of(str(source.relative_to(ROOT)))
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.suffix not in (".md", ".ipynb"):
            shutil.copy(source, target)
            continue
        print(f"{source.relative_to(ROOT)} ...", flush=True)
        notebook = read_source(source, execute)
        index = os.path.relpath(folder / "index.html", target.parent)
        is_index = source == ROOT / "README.md"
        target.write_text(html_of(notebook, "" if is_index else index), encoding="utf-8")
        named = dict.fromkeys(named_files(notebook, source.parent))
        sources += [path for path in named if path not in sources]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Writes the notebooks as pages.")
    parser.add_argument("folder", type=Path, help="begins with index.html")
    parser.add_argument("--execute", action="store_true", help="run the notebooks")
    chosen = parser.parse_args()
    sources = [ROOT / "README.md", *sorted(ROOT.glob("notebooks/*.ipynb"))]
    try:
        if chosen.execute:
            open_scenes(load_preset())  # what is missing is told before hours of work
        write_pages(chosen.folder, sources, chosen.execute)
    except NbtrackError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    except CellExecutionError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
