"""The package's folders and which way they depend on each other, read from the imports of every module."""

from __future__ import annotations

import ast
import graphlib
import re
from pathlib import Path

import sadgs_ns

ROOT = Path(sadgs_ns.__file__).parent
USES = {
    # folder: the other folders that its modules may import; all may import the modules that lie flat in the package
    "cli": {"placing", "training", "viewer", "formats", "data", "geometry", "method", "render", "kernels"},
    "training": {"viewer", "data", "geometry", "method", "distributed", "render", "kernels"},
    "viewer": {"geometry", "method", "render"},
    "placing": {"data"},
    "formats": {"data"},
    "data": {"geometry"},  # Which points count as outliers
    "geometry": {"render"},
    "method": {"distributed", "render", "kernels"},
    "distributed": {"render", "kernels"},
    "render": {"kernels"},
    "kernels": set(),
    "": set(),
}
MAX_FLAT = 9
MAX_LINES = 600
"""Most lines of a file of the package."""
NO_KERNELS = {"shared", "trial"}
"""Files of `kernels` whose functions are tested with other kernels, or by themselves."""


def names_imported(path: Path) -> set[str]:
    """What a file imports, in functions and for type checkers, too: modules, and their members as if they were some."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text("utf8"))):
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
    actual = {folder(name) for name in FILES}
    assert actual == USES.keys()
    for name, imported in GRAPH.items():
        wrong = [other for other in imported if folder(other) not in {folder(name), "", *USES[folder(name)]}]
        assert not wrong, f"{name} must not import {wrong}"


def test_no_module_imports_itself_through_others():
    order = list(graphlib.TopologicalSorter(GRAPH).static_order())  # CycleError names a circle.
    assert set(order) >= GRAPH.keys()


def test_the_method_knows_nothing_of_nerfstudio():
    for name, imported in IMPORTED.items():
        # What these import of ours, even indirectly, lies in them or flat in the package.
        if folder(name) in ("formats", "geometry", "method", "distributed", "render", "kernels", ""):
            wrong = [other for other in imported if other.partition(".")[0] == "nerfstudio"]
            assert not wrong, f"{name} must not import {wrong}"


def test_the_package_knows_nothing_of_what_a_checkout_holds_beside_it():
    for name, imported in IMPORTED.items():
        wrong = [other for other in imported if other.partition(".")[0] in ("benchmarks", "examples", "tests")]
        assert not wrong, f"{name} must not import {wrong}"


def test_few_modules_lie_flat_in_the_package():
    assert len(list(ROOT.glob("*.py"))) <= MAX_FLAT


def test_no_file_is_too_long():
    lines = {path.relative_to(ROOT).as_posix(): path.read_text("utf8").count("\n") for path in ROOT.rglob("*.py")}
    actual = {name: number for name, number in lines.items() if number > MAX_LINES}
    assert actual == {}


def test_each_file_of_kernels_has_a_module_of_tests_with_its_name():
    """So that `pytest tests -k NAME` runs the tests of one kernel."""
    modules = {path.stem for path in (ROOT.parent / "tests").rglob("test_*.py")}
    without_tests = []
    for path in sorted((ROOT / "kernels").glob("*.py")):
        launches = "@triton.jit" in path.read_text("utf8")
        expected = {f"test_{path.stem}", f"test_{path.stem}_kernel"}
        if launches and path.stem not in NO_KERNELS and modules.isdisjoint(expected):
            without_tests.append(path.name)
    assert without_tests == []


def names_of_gsplat(path: Path) -> set[str]:
    """Dotted names in gsplat that a file imports (for type checkers, too), reads from what it imports, or quotes."""
    names = set()
    bound = {}
    nodes = list(ast.walk(ast.parse(path.read_text("utf8"))))
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                names.add(alias.name)
                bound |= {alias.asname: alias.name} if alias.asname else {alias.name.partition(".")[0]: None}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
            bound |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    for node in nodes:
        if isinstance(node, ast.Attribute):
            first, _, rest = ast.unparse(node).partition(".")
            if first in bound:
                names.add(f"{bound[first] or first}.{rest}")
        elif isinstance(node, ast.Constant) and re.fullmatch(r"gsplat(\.\w+)+", str(node.value)):
            names.add(node.value)
    return {name for name in names if f"{name}.".startswith("gsplat.")}


def is_private(name: str) -> bool:
    """Whether a dotted name in gsplat is one that a release may change: in `gsplat.cuda`, or behind an underscore."""
    parts = name.split(".")[1:]
    return parts[:1] == ["cuda"] or any(part.startswith("_") and not part.endswith("__") for part in parts)


def test_no_module_knows_the_internals_of_gsplat():
    private = {name: sorted(filter(is_private, names_of_gsplat(path))) for name, path in FILES.items()}
    wrong = {name: names for name, names in private.items() if names}
    assert not wrong, f"these are private in gsplat: {wrong}"


def test_private_names_of_gsplat_are_found_however_they_are_reached(tmp_path: Path):
    for source, found in (
        ("import gsplat.cuda._backend", True),
        ("import gsplat\ngsplat.cuda._wrapper.f()", True),
        ("from gsplat import cuda", True),
        ("from gsplat.strategy import ops as o\no._update_param_with_optimizer()", True),
        ("from gsplat.strategy.ops import _update_param_with_optimizer", True),
        ("import importlib\nimportlib.import_module('gsplat.cuda._backend')", True),
        ("import gsplat\nprint(gsplat.__version__, gsplat.rasterization)", False),
        ("from gsplat.strategy.ops import remove\nimport torch\ntorch._dynamo", False),
        ("import torch\n'gsplat.cuda is a folder'", False),
    ):
        file = tmp_path / "source.py"
        file.write_text(source, "utf8")
        assert any(map(is_private, names_of_gsplat(file))) is found, source
