"""Options that several benchmarks share: ``--out`` and the file it names."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any


def parser(name: str, description: str) -> argparse.ArgumentParser:
    """A benchmark's parser, with the option ``--out``.

    Args:
        name: name of the benchmark's module.
        description: one sentence for ``--help``.
    """
    made = argparse.ArgumentParser(prog=f"python -m benchmarks.{name}", description=description)
    made.add_argument("--out", type=Path, help="also write the figures as JSON here")
    return made


def add_turns(parser: argparse.ArgumentParser, quick: str, rounds: int) -> None:
    """Add ``--quick`` and ``--rounds`` of a benchmark that measures its cases in turn.

    Args:
        parser: parser of the benchmark.
        quick: measurements of ``--quick``.
        rounds: times each case is measured by default.
    """
    parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument(
        "--rounds",
        type=int,
        default=rounds,
        help=f"times each case is measured (default {rounds})",
    )


def write_figures(path: Path | None, figures: Any) -> None:
    """Write what ``--out`` asks for as JSON; nothing where it was left out."""
    if path is not None:
        write_text(path, json.dumps(figures, indent=1))


def write_text(path: Path, text: str) -> None:
    """Write a file's text with a newline at its end, in a folder that is made if need be."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{text}\n")
