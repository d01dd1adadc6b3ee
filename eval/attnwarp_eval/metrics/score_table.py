"""Scores of pairs of views by networks that no package carries, in a file of whoever has them.

A CSV: columns that name a pair, and columns of scores, whose titles end in what is better, such as
``MEt3R lower`` or ``VGGT confidence higher``. An empty cell is undefined.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from attnwarp.errors import InputError

Scores = dict[str, dict[tuple[str, ...], float]]
"""Figure -> names of the pair -> score."""


def read_scores(path: Path, columns: Sequence[str], option: str) -> Scores:
    """Scores of a file by figure, such as "consistency.score_lower.MEt3R".

    Raises:
        InputError: the file cannot be read, a column of no known meaning, or a score that is no
            number.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            table = csv.DictReader(file)
            titles = list(table.fieldnames or [])
            own = [title for title in titles if title not in columns]
            if not own or set(columns) - set(titles) or not all(map(_key, own)):
                raise InputError(
                    f"{option}: {path} has the columns {', '.join(titles)}; expected"
                    f" {', '.join(columns)} and scores such as 'MEt3R lower'"
                )
            found: Scores = {_key(title): {} for title in own}
            for row in table:
                pair = tuple(row[column] for column in columns)
                for title in own:
                    where = f"{option}: {path}:{table.line_num}"
                    found[_key(title)][pair] = _number(row[title], where)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{option}: {path} cannot be read ({error})") from None
    return found


def _key(title: str) -> str:
    """Figure of a column; empty for a title that doesn't say what is better."""
    name, _, better = title.rpartition(" ")
    return f"consistency.score_{better}.{name}" if name and better in ("higher", "lower") else ""


def _number(text: str | None, where: str) -> float:
    try:
        return float(text) if text else math.nan
    except ValueError:
        raise InputError(f"{where}: got {text!r}, expected a number") from None
