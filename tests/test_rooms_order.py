"""A room of the package imports only rooms before it."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "nbtrack"
ORDER = [
    "machinery",
    *("core", "data", "fields", "mapping", "tracking", "latex", "tables"),  # what the paper needs
    *("recordings", "checks", "beyond", "provenance", "synthetic", "plots"),
    *("experiments", "cli", "__main__"),
]  # fmt: skip
MODULES = {
    ".".join(["nbtrack", *path.relative_to(PACKAGE).with_suffix("").parts]): path
    for path in PACKAGE.rglob("*.py")
}


def imports(path: Path) -> set[str]:
    """Modules of the package that a module imports anywhere, in its functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path} imports relatively"
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    packages = {name: f"{name}.__init__" for name in found}
    return {m for name in found for m in (name, packages[name]) if m in MODULES}


def test_rooms_import_earlier_rooms_only() -> None:
    """Catches a step back up: an earlier room gets what it needs as an argument."""
    for name, path in MODULES.items():
        room = name.split(".")[1]
        if room != "__init__":  # the public face
            later = ORDER[ORDER.index(room) + 1 :]
            wrong = [other for other in imports(path) if other.split(".")[1] in later]
            assert not wrong, f"{name} imports {wrong}"


@pytest.mark.parametrize("path", MODULES.values(), ids=MODULES)
def test_functions_are_small(path: Path) -> None:
    """Catches a function of more than 40 lines."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef):
            lines = node.end_lineno - node.lineno + 1
            assert lines <= 40, f"{node.name} has {lines} lines"


def test_no_circle_of_imports() -> None:
    """Catches modules of one room that import each other: which of them works then depends on which
    is imported first. A package's public face imports its modules and is left out."""
    modules = {name: path for name, path in MODULES.items() if not name.endswith("__init__")}
    graph = {name: imports(path) & modules.keys() for name, path in modules.items()}
    TopologicalSorter(graph).prepare()
