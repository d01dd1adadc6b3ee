"""Check that overwriting a table loses no rows."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from pathlib import Path

from attnwarp.errors import InputError
from attnwarp_eval.study.store import Store

Key = tuple[str, ...]
"""Key of a row, such as a question and a scene."""


def check_nothing_is_lost(
    path: Path, table: str | None, fields: Sequence[str], available: Collection[Key]
) -> set[Key]:
    """Check that a table can be overwritten: its folder has cells, and each row will be rewritten.

    A folder without cells has results from elsewhere, such as a published report. Recomputed
    results would differ, so such a table is not overwritten.

    Args:
        path: path of the table's JSON, in the run's folder; may be missing.
        table: key of the list of rows; None if the file is only the list.
        fields: keys of a row that identify it.
        available: keys of the rows that the call computes.

    Returns:
        The rows of the table.

    Raises:
        InputError: a row would be lost, or the file is not such a table.
    """
    if not path.exists():
        return set()
    remedy = "name another folder with --out, or move the file away"
    try:
        content = json.loads(path.read_bytes())
        rows = content if table is None else content[table]
        stored = {tuple(str(row[field]) for field in fields) for row in rows}
    except (ValueError, LookupError, TypeError, OSError):
        raise InputError(f"{path}: is not a file that this command wrote; {remedy}") from None
    lost = sorted(stored.difference(available) if Store(path.parent).done() else stored)
    if lost:
        more = f" and {len(lost) - 3} more" if len(lost) > 3 else ""
        names = ", ".join(" of ".join(key) for key in lost[:3])
        raise InputError(
            f"{path}: {names}{more} would be lost; ask for them too (what is finished in this"
            f" folder is not measured again), {remedy}"
        )
    return stored
