"""Lint of docstrings' first words: ``python -m scripts.check_docstrings`` (``make lint``)."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

FOLDERS = ("attnwarp", "benchmarks", "eval", "scripts", "tests")
FRAGMENT = re.compile(
    r"\s*(Of|What|Where|Whether|Which|Who|Whose|Why|How|The same|See|When|Not|As)\b"
)
"""First words of a docstring that begins with neither a noun nor an imperative verb."""

ENTRY = re.compile(r"(?m)^ +[a-z_0-9]+(?:, [a-z_0-9]+)*: (of|what|whose|see there)[ .,:;]")
"""Entry of ``Args:`` or ``Attributes:`` that does not begin with a noun, and its first words."""


def docstrings(tree: ast.AST) -> Iterator[ast.Constant]:
    """Docstrings of a module, its classes and functions, and the strings below assignments."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            for statement in node.body:
                if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                    yield statement.value


def fragments(text: str) -> Iterator[tuple[int, str]]:
    """Line and first words of each docstring, or entry of one, that begins as a fragment."""
    for constant in docstrings(ast.parse(text)):
        if not isinstance(constant.value, str):
            continue
        if found := FRAGMENT.match(constant.value):
            yield constant.lineno, found[1]
        for found in ENTRY.finditer(constant.value):
            yield constant.lineno + constant.value.count("\n", 0, found.start()), found[1]


if __name__ == "__main__":
    failed = False
    for path in sorted(path for folder in FOLDERS for path in Path(folder).rglob("*.py")):
        for line, words in fragments(path.read_text(encoding="utf-8")):
            print(f"{path}:{line}: begins with {words!r}; begin with a noun or an imperative verb")
            failed = True
    sys.exit(failed)
