"""Lint of docstrings, their first words and short lines: ``python -m scripts.check_docstrings``
(``make lint``).
"""

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


WIDTH = 88
"""Length in characters that a line inside a paragraph reaches, or its next word would exceed."""

LAYOUT = re.compile(r"  |::$|\.\.\. |>>> |[-*|`<]|.*[=:|]$|\w+(\[.*\])?: ")
"""Begin, or all, of a line that is laid out by hand: a table, a list, code, an entry."""


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


def broken(text: str) -> Iterator[tuple[int, str]]:
    """Line and text of each docstring's line that ends early inside a paragraph, as a reflow leaves
    it."""
    source = text.splitlines()
    for constant in docstrings(ast.parse(text)):
        if not isinstance(constant.value, str):
            continue
        last, code = constant.end_lineno or constant.lineno, False
        for number in range(constant.lineno, last):
            line, following = source[number - 1], source[number]
            code = (code and bool(line.strip())) or line.rstrip().endswith(("::", ">>>"))
            words, after = line.strip().removeprefix('"""'), following.strip()
            indent, below = (len(part) - len(part.lstrip()) for part in (line, following))
            code = code or (constant.col_offset == 0 and indent > 0)
            prose = words and after and not code and (indent == below or number == constant.lineno)
            if not prose or any("  " in part or LAYOUT.match(part) for part in (words, after)):
                continue
            fits = len(line) + 1 + len(after.split()[0]) <= WIDTH
            if fits and words[-1] not in ".:;!?" and after != '"""':
                yield number, words


if __name__ == "__main__":
    failed = False
    for path in sorted(path for folder in FOLDERS for path in Path(folder).rglob("*.py")):
        for line, words in fragments(path.read_text(encoding="utf-8")):
            print(f"{path}:{line}: begins with {words!r}; begin with a noun or an imperative verb")
            failed = True
        for line, words in broken(path.read_text(encoding="utf-8")):
            print(f"{path}:{line}: ends early: {words!r}; join it with the next line")
            failed = True
    sys.exit(failed)
