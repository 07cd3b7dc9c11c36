"""The questions of newcomers to the code and of users have their answers where questions.yaml and its twin say."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

CHECKOUT = Path(__file__).parents[2]
QUESTIONS, OF_READERS = (
    yaml.safe_load((CHECKOUT / f"tests/{name}.yaml").read_text("utf8")) for name in ("questions", "reader_questions")
)


def defined(nodes: list[ast.stmt]) -> Iterator[str]:
    """Names of functions, classes, methods and values of a module's statements."""
    for node in nodes:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            yield node.name
        if isinstance(node, ast.ClassDef):
            yield from (part.name for part in node.body if isinstance(part, ast.FunctionDef))
        targets = getattr(node, "targets", [getattr(node, "target", None)])
        yield from (target.id for target in targets if isinstance(target, ast.Name))


@pytest.mark.parametrize("asked", QUESTIONS, ids=lambda asked: asked["name"])
def test_what_answers_a_question_is_where_it_is_expected(asked: dict[str, str]):
    path = CHECKOUT / asked["file"]
    assert path.is_file(), asked["question"]
    assert asked["name"] in set(defined(ast.parse(path.read_text("utf8")).body)), asked["question"]


@pytest.mark.parametrize("asked", OF_READERS, ids=lambda asked: asked["question"])
def test_a_document_answers_a_reader_s_question(asked: dict[str, str]):
    text = " ".join((CHECKOUT / asked["file"]).read_text("utf8").split())
    assert text.count(asked["phrase"]) == 1, asked["answer"]
