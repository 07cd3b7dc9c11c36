"""Hard cases say what happens, links lead somewhere, and tables are what their rows give."""

from __future__ import annotations

import ast
import re
import unicodedata
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from benchmarks import __main__ as benchmarks
from helpers import hard_cases

CHECKOUT = Path(__file__).parents[2]


@cache
def names_in(file: str) -> tuple[set[str], set[str]]:
    """Names of a module's test functions, and the keys of its dictionaries."""
    tree = ast.parse((CHECKOUT / file).read_text("utf8")).body
    tests = {node.name for node in tree if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")}
    dicts = [node.value for node in tree if isinstance(node, ast.Assign) and isinstance(node.value, ast.Dict)]
    return tests, {str(key.value) for cases in dicts for key in cases.keys if isinstance(key, ast.Constant)}


def test_each_hard_case_says_what_is_tried_and_what_happens_on_the_site_s_page():
    page = hard_cases.page()
    rows = [(file, row) for file, _, cases in hard_cases.modules() for row in cases]
    assert len(rows) >= 300
    for file, row in rows:
        assert f"| {hard_cases.cell(row.case)} | {hard_cases.cell(row.outcome)} | `" in page
        named = {name for name in row.parameters if "*" not in name}
        assert named <= names_in(f"tests/{file}")[1], (file, row.case)


@pytest.mark.parametrize("arguments", ["", '"a case"', '"a case", ""', '"a case", SENTENCE', 'case="a", outcome="b"'])
def test_a_hard_case_without_both_texts_is_refused(arguments: str, tmp_path: Path):
    source = f"@pytest.mark.hard_case({arguments})\ndef test_something():\n    pass\n"
    (tmp_path / "test_some.py").write_text(source, "utf8")
    with pytest.raises(ValueError, match=r"^test_some\.py:1: hard_case "):
        hard_cases.page(tmp_path)


def test_tables_are_what_their_rows_give(capsys: pytest.CaptureFixture[str]):
    status = benchmarks.main(["documents", str(CHECKOUT), "--check"])
    assert status == 0, "".join(capsys.readouterr())


DOCUMENTS = [CHECKOUT / "README.md", CHECKOUT / "CHANGELOG.md", *sorted((CHECKOUT / "docs").glob("*.md"))]


def without_code(text: str) -> str:
    """A document's lines that are no code."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    return "\n".join(line for line in text.splitlines() if not line.startswith("    "))


def anchors(path: Path) -> set[str]:
    """What a document's headings are called in links, as GitHub does."""
    found = set[str]()
    names = Counter[str]()
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
    assert {path for path in (CHECKOUT / "docs/figures").iterdir()} <= shown


def test_every_test_that_a_document_names_is_there():
    files = [str(path.relative_to(CHECKOUT)) for path in CHECKOUT.glob("tests/**/test_*.py")]
    known = {name for file in files for name in names_in(file)[0]} | {Path(file).stem for file in files}
    named = {name for path in DOCUMENTS for name in re.findall(r"\btest_[a-z\d]+_[a-z\d]+_\w+", path.read_text("utf8"))}
    assert len(named) > 20, named - known
    assert named <= known, named - known


def test_the_version_and_its_date_are_the_same_wherever_they_stand():
    patterns = {
        "pyproject.toml": r'^version = "(.+)"$',
        "CITATION.cff": r"^version: (.+)\ndate-released: (.+)$",
        "CHANGELOG.md": r"^## \[(.+?)\] - (\d{4}-\d\d-\d\d|unreleased)$",
    }
    found = {file: re.search(at, (CHECKOUT / file).read_text("utf8"), re.MULTILINE) for file, at in patterns.items()}
    package, citation, changelog = [match.groups() for match in found.values() if match]
    version, candidate = re.fullmatch(r"([\d.]+)(rc\d+)?", package[0]).groups()  # pyright: ignore
    assert citation[:1] == package
    assert changelog == (version, "unreleased" if candidate else citation[1])


def test_no_line_of_the_readme_is_too_long():
    lines = (CHECKOUT / "README.md").read_text("utf8").splitlines()
    assert max(map(len, lines)) <= 120
