"""Every row of the tables of hard cases names tests that there are."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[1]


@cache
def names_in(file: str) -> tuple[set[str], set[str]]:
    """Names of a module's test functions, and the keys of its dictionaries."""
    tree = ast.parse((CHECKOUT / file).read_text("utf8")).body
    tests = {node.name for node in tree if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")}
    dicts = [node.value for node in tree if isinstance(node, ast.Assign) and isinstance(node.value, ast.Dict)]
    return tests, {str(key.value) for cases in dicts for key in cases.keys if isinstance(key, ast.Constant)}


def rows_of_hard_cases(document: str) -> list[tuple[str, str]]:
    """The last cells of the tables' rows, each with the module that its section names first."""
    text = (CHECKOUT / document).read_text("utf8")
    if document == "README.md":
        text = re.findall(r"^## Hard cases$.*?(?=^## )", text, re.MULTILINE | re.DOTALL)[0]
    rows = []
    for section in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        modules = re.findall(r"tests/(?:\w+/)?test_\w+\.py", section)
        table = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("| ")]
        table = [cells for cells in table if not cells[0].startswith("**")][2:]  # without groups and header
        assert {len(cells) for cells in table} in ({3}, {4})  # one section also says what was before
        rows += [(modules[0], cells[-1]) for cells in table]
    return rows


@pytest.mark.parametrize(("document", "at_least"), [("README.md", 12), ("docs/hard-cases.md", 100)])
def test_every_hard_case_names_a_test_that_there_is(document: str, at_least: int):
    rows = rows_of_hard_cases(document)
    assert len(rows) >= at_least
    for module, cell in rows:
        names = re.findall(r"`([^`]+)`", cell)
        assert names or cell in ("the same", "tried by hand", "–"), cell
        for name in names:
            found = re.fullmatch(r"(?:(tests/(?:\w+/)?test_\w+\.py)::)?(test_\w+)?(?:\[(.+)\])?", name)
            assert found, name
            tests, cases = names_in(found[1] or module)
            if found[2] is None:
                assert found[3] in cases, name
            else:
                assert found[2] in tests, name
