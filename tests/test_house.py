"""The package's folders and which way they depend on each other, read from the imports of every module."""

from __future__ import annotations

import ast
import graphlib
from collections.abc import Iterator
from pathlib import Path

import sadgs_ns

ROOT = Path(sadgs_ns.__file__).parent
USES = {
    # folder: the other folders that its modules may import; all may import the modules that lie flat in the package
    "bench": {"demo", "cli", "plugin", "data", "method", "render", "kernels"},
    "demo": {"cli", "plugin", "data", "method", "render", "kernels"},
    "cli": {"plugin", "data", "method", "render", "kernels"},
    "plugin": {"data", "method", "render", "kernels"},
    "data": set(),
    "method": {"render", "kernels"},
    "render": {"kernels"},
    "kernels": set(),
    "": set(),
}
MAX_FLAT = 6


def nodes_that_run(tree: ast.AST) -> Iterator[ast.AST]:
    """All nodes of a module, in functions too, except what is imported for type checkers alone."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        yield node
        yield from nodes_that_run(node)


def names_imported(path: Path) -> set[str]:
    """What a file imports: modules, and the members of modules as if they were modules."""
    names = set()
    for node in nodes_that_run(ast.parse(path.read_text("utf8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


FILES = {".".join(("sadgs_ns", *path.relative_to(ROOT).with_suffix("").parts)): path for path in ROOT.rglob("*.py")}
FILES = {name.removesuffix(".__init__"): path for name, path in FILES.items()}
IMPORTED = {name: names_imported(path) for name, path in FILES.items()}


def modules_of_ours(name: str) -> set[str]:
    """Modules of this package that a module imports."""
    found = {n if n in FILES else n.rpartition(".")[0] for n in IMPORTED[name] if f"{n}.".startswith("sadgs_ns.")}
    assert found <= FILES.keys(), f"{name} imports {found - FILES.keys()}"
    return found - {"sadgs_ns"}


GRAPH = {name: modules_of_ours(name) for name in FILES}


def folder(name: str) -> str:
    """Folder of a module, or "" of one that lies flat in the package."""
    _, _, inside = name.partition(".")
    first = inside.partition(".")[0]
    return first if (ROOT / first).is_dir() else ""


def test_the_folders_depend_on_each_other_in_one_way():
    assert {folder(name) for name in FILES} == USES.keys()
    for name, imported in GRAPH.items():
        wrong = [other for other in imported if folder(other) not in {folder(name), "", *USES[folder(name)]}]
        assert not wrong, f"{name} must not import {wrong}"


def test_no_module_imports_itself_through_others():
    list(graphlib.TopologicalSorter(GRAPH).static_order())  # raises CycleError, which names the circle


def test_the_method_knows_nothing_of_nerfstudio():
    for name, imported in IMPORTED.items():
        # What these three import of ours, even indirectly, lies in them or flat in the package.
        if folder(name) in ("method", "render", "kernels", ""):
            wrong = [other for other in imported if other.partition(".")[0] == "nerfstudio"]
            assert not wrong, f"{name} must not import {wrong}"


def test_few_modules_lie_flat_in_the_package():
    assert len(list(ROOT.glob("*.py"))) <= MAX_FLAT
