"""The page of hard cases, written from the tests' `hard_case` markers.

A marker names a case and what happens in it: `@pytest.mark.hard_case("an image of 0 bytes", "refused")`. Further
arguments name the parameters of the test that try it. The tests are parsed and not imported, so that neither torch nor
a GPU is needed. `python tests/helpers/hard_cases.py` prints the page, and mkdocs adds it to the site with `on_files`.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

TESTS = Path(__file__).parents[1]

HEAD = """# Hard cases

These inputs and accidents were tried. Each row is a test, run by `make test`; `pytest -m hard_case` runs these tests
alone. Without a GPU the Triton kernels run in Triton's interpreter, with one on the GPU. *Refused* means that the
command ends with one sentence that names the input and the remedy, with exit code 1 and without a traceback, and writes
nothing.
"""


@dataclass
class HardCase:
    test: str
    case: str
    outcome: str
    parameters: tuple[str, ...]


def literal(node: ast.expr, where: str) -> str:
    """The text of a marker's argument; an error unless it is one."""
    if not (isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.strip()):
        raise ValueError(f"{where}: hard_case takes texts that are not empty: the case, what happens, and parameters.")
    return node.value


def cases_of(module: ast.Module, file: str) -> Iterator[HardCase]:
    for test in [node for node in module.body if isinstance(node, ast.FunctionDef)]:
        for marker in test.decorator_list:
            if not ast.unparse(marker).startswith("pytest.mark.hard_case"):
                continue
            where = f"{file}:{marker.lineno}"
            if not isinstance(marker, ast.Call) or len(marker.args) < 2 or marker.keywords:
                raise ValueError(f"{where}: hard_case needs two texts: the case, and what happens.")
            case, outcome, *parameters = [literal(argument, where) for argument in marker.args]
            yield HardCase(test.name, case, outcome, tuple(parameters))


def modules(folder: Path = TESTS) -> Iterator[tuple[str, ast.Module, list[HardCase]]]:
    """The test files that have hard cases, by their paths below `folder`."""
    for path in sorted(folder.rglob("test_*.py")):
        file = path.relative_to(folder).as_posix()
        module = ast.parse(path.read_text("utf8"))
        cases = list(cases_of(module, file))
        if cases:
            yield file, module, cases


def cell(text: str) -> str:
    return text.replace("|", "\\|")


def page(folder: Path = TESTS) -> str:
    """The page in Markdown: a section for each folder and test file, which its docstring introduces."""
    parts = [HEAD]
    last = ""
    for file, module, cases in modules(folder):
        section = Path(file).parent.name or "all"
        if section != last:
            parts.append(f"## {section.capitalize()}\n")
            last = section
        parts.append(f"### `{file}`\n\n{ast.get_docstring(module) or ''}\n")
        rows = ["| Case | What happens | Test |", "| --- | --- | --- |"]
        for row in cases:
            tests = ", ".join(f"`[{name}]`" for name in row.parameters) or f"`{row.test}`"
            rows.append(f"| {cell(row.case)} | {cell(row.outcome)} | {tests} |")
        parts.append("\n".join(rows) + "\n")
    return "\n".join(parts)


def on_files(files, config):
    """Called by mkdocs with the files of the site."""
    from mkdocs.structure.files import File  # pyright: ignore[reportMissingImports]

    files.append(File.generated(config, "hard-cases.md", content=page()))
    return files


if __name__ == "__main__":
    print(page(), end="")
