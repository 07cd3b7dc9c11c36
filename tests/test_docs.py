"""Hard cases name tests that there are, links lead somewhere, and tables are what their rows give."""

from __future__ import annotations

import ast
import re
import unicodedata
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from benchmarks import documents

CHECKOUT = Path(__file__).parents[1]


@cache
def names_in(file: str) -> tuple[set[str], set[str]]:
    """Names of a module's test functions, and the keys of its dictionaries."""
    tree = ast.parse((CHECKOUT / file).read_text("utf8")).body
    tests = {node.name for node in tree if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")}
    dicts = [node.value for node in tree if isinstance(node, ast.Assign) and isinstance(node.value, ast.Dict)]
    return tests, {str(key.value) for cases in dicts for key in cases.keys if isinstance(key, ast.Constant)}


def rows_of_hard_cases() -> list[tuple[str, str]]:
    """The last cells of the tables' rows, each with the module that its section names first."""
    text = (CHECKOUT / "docs/hard-cases.md").read_text("utf8")
    rows = []
    for section in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        modules = re.findall(r"tests/(?:\w+/)?test_\w+\.py", section)
        table = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("| ")]
        table = [cells for cells in table if not cells[0].startswith("**")][2:]  # without groups and header
        assert {len(cells) for cells in table} in ({3}, {4})  # one section also says what was before
        rows += [(modules[0], cells[-1]) for cells in table]
    return rows


def test_every_hard_case_names_a_test_that_there_is():
    rows = rows_of_hard_cases()
    assert len(rows) >= 100
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


def test_tables_are_what_their_rows_give(capsys: pytest.CaptureFixture[str]):
    assert documents.main([str(CHECKOUT), "--check"]) == 0, "".join(capsys.readouterr())


DOCUMENTS = [CHECKOUT / "README.md", CHECKOUT / "CHANGELOG.md", *sorted((CHECKOUT / "docs").glob("*.md"))]


def without_code(text: str) -> str:
    """A document's lines that are no code."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    return "\n".join(line for line in text.splitlines() if not line.startswith("    "))


def anchors(path: Path) -> set[str]:
    """What a document's headings are called in links, as GitHub does."""
    found, names = set[str](), Counter[str]()
    for heading in re.findall(r"^#+ +(.+)$", without_code(path.read_text("utf8")), re.MULTILINE):
        text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
        kept = "".join(c for c in text if c in "-_ " or unicodedata.category(c)[0] in "LMN")
        name = kept.replace(" ", "-")
        found.add(f"{name}-{names[name]}" if names[name] else name)
        names[name] += 1
    return found


def links(path: Path) -> list[str]:
    """Where a document's links and images lead."""
    text = re.sub(r"`[^`\n]*`", "", without_code(path.read_text("utf8")))
    return re.findall(r"\]\(([^)\s]+)\)", text)


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_links_between_documents_lead_somewhere(path: Path):
    for link in links(path):
        if re.match(r"[a-z]+:", link):
            continue
        file, _, anchor = link.partition("#")
        target = (path.parent / file).resolve() if file else path
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def texts_of_the_code() -> Iterator[tuple[str, str]]:
    """Files that may name documents, and what they hold."""
    for folder, pattern in (("sadgs_ns", "*.py"), ("tests", "*.py"), ("configs", "*.yaml")):
        for path in sorted((CHECKOUT / folder).rglob(pattern)):
            yield str(path.relative_to(CHECKOUT)), path.read_text("utf8")


def test_documents_that_the_code_names_are_there():
    reference = r"\b(docs/[\w-]+\.md)(?:#([\w-]+))?"
    named = [(file, *found) for file, text in texts_of_the_code() for found in re.findall(reference, text)]
    assert len(named) > 10
    for file, document, anchor in named:
        assert (CHECKOUT / document).exists(), (file, document)
        assert not anchor or anchor in anchors(CHECKOUT / document), (file, anchor)


def test_every_figure_is_shown():
    shown = {(path.parent / link).resolve() for path in DOCUMENTS for link in links(path)}
    assert {path for path in (CHECKOUT / "docs" / "figures").iterdir()} <= shown


def test_every_test_that_a_document_names_is_there():
    files = [str(path.relative_to(CHECKOUT)) for path in CHECKOUT.glob("tests/**/test_*.py")]
    known = {name for file in files for name in names_in(file)[0]} | {Path(file).stem for file in files}
    named = {name for path in DOCUMENTS for name in re.findall(r"\btest_[a-z\d]+_[a-z\d]+_\w+", path.read_text("utf8"))}
    assert len(named) > 100 and named <= known, named - known


def test_the_version_and_its_date_are_the_same_wherever_they_stand():
    patterns = {
        "pyproject.toml": r'^version = "(.+)"$',
        "CITATION.cff": r"^version: (.+)\ndate-released: (.+)$",
        "CHANGELOG.md": r"^## \[Unreleased\]$(?s:.*?)^## \[(.+?)\] - (\d{4}-\d\d-\d\d)$",
    }
    found = {file: re.search(at, (CHECKOUT / file).read_text("utf8"), re.MULTILINE) for file, at in patterns.items()}
    package, citation, changelog = [match.groups() for match in found.values() if match]
    assert citation == changelog and package == changelog[:1]


def test_the_readme_is_read_in_two_minutes():
    lines = (CHECKOUT / "README.md").read_text("utf8").splitlines()
    assert len(lines) <= 120 and max(map(len, lines)) <= 120
