"""Lines of code by package, without docstrings, comments and blank lines: ``make count``."""

from __future__ import annotations

import ast
from pathlib import Path

ROWS = (
    ("attnwarp",),
    ("eval/attnwarp_eval",),
    ("eval/attnwarp_lab",),
    ("eval/training",),
    ("tests",),
    ("benchmarks", "scripts"),
)
"""Folders of each row of the table."""

DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def code_lines(text: str) -> int:
    """Count the lines of a module that are neither blank, comment, nor docstring."""
    documentation: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            docstring = node.body[0]
            documentation.update(range(docstring.lineno, (docstring.end_lineno or 0) + 1))
    return sum(
        number not in documentation and line.strip() != "" and not line.lstrip().startswith("#")
        for number, line in enumerate(text.splitlines(), 1)
    )


if __name__ == "__main__":
    total = 0
    for folders in ROWS:
        paths = [path for folder in folders for path in Path(folder).rglob("*.py")]
        count = sum(code_lines(path.read_text(encoding="utf-8")) for path in paths)
        total += count
        print(f"{', '.join(folders):<20} {count:>8,}")
    print(f"{'all':<20} {total:>8,}")
