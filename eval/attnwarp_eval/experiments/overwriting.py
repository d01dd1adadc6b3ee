"""Tables that a later call overwrites: what only they hold must not be lost."""

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
    """Check that a table can be overwritten: its folder has cells, and each row will be there.

    A folder without cells has results from elsewhere, such as a published report. Made again they
    would be others, so none of them is overwritten.

    Args:
        path: path of the table's JSON, in the run's folder; there may be none yet.
        table: the key of the list of rows; None where the list is all there is.
        fields: the keys of a row that name it.
        available: the rows that the call makes.

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
