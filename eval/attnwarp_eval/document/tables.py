"""Tables of a report as files of LaTeX and CSV, with captions."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable
from pathlib import Path

from attnwarp_eval.document.model import Report, Table
from attnwarp_eval.files import write_atomic

_LATEX = {
    **{character: rf"\{character}" for character in "{}&%$#_"},
    **{character: f"${character}$" for character in "<>"},
    **{character: f"{{{character}}}" for character in "[]"},  # a bare one is an argument of \\
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "|": r"\textbar{}", '"': "{''}", "–": "--", "±": r"$\pm$", "×": r"$\times$",
    "°": r"$^\circ$", "†": r"$\dagger$",
}  # fmt: skip
"""Characters that mean something to LaTeX, or that a font may lack."""

_CODE, _BOLD = re.compile(r"`([^`]+)`"), re.compile(r"\*\*([^*]+)\*\*")


def latex_text(text: str) -> str:
    """Text for LaTeX without any package; `code` and **bold** stay so.

    Example:
        >>> print(latex_text("`shared_noise` ± 5 %"))
        \\texttt{shared\\_noise} $\\pm$ 5 \\%
    """
    escaped = "".join(_LATEX.get(character, character) for character in " ".join(text.split()))
    return _BOLD.sub(r"\\textbf{\1}", _CODE.sub(r"\\texttt{\1}", escaped))


def latex_table(table: Table, caption: str) -> str:
    """A floating table of LaTeX, without any package.

    Example:
        >>> text = latex_table(Table(["variant", "AbsRel"], [["paper", "0.01"]]), "Depth.")
        >>> "paper & 0.01 \\\\\\\\" in text
        True
    """
    head, *rows = (
        " & ".join(map(latex_text, row)) + r" \\" for row in (table.columns, *table.rows)
    )
    lines = [
        r"\begin{table}", r"\centering", rf"\caption{{{latex_text(caption)}}}",
        rf"\begin{{tabular}}{{{'l' * len(table.columns)}}}", r"\hline", head,
        r"\hline", *rows, r"\hline", r"\end{tabular}", r"\end{table}",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def csv_table(table: Table, caption: str) -> str:
    """Comma-separated values; the first line is the caption, as a comment.

    Example:
        >>> csv_table(Table(["variant", "AbsRel"], [["paper", "0.01"]]), "Depth.").splitlines()
        ['# Depth.', 'variant,AbsRel', 'paper,0.01']
    """
    stream = io.StringIO()
    rows = [[_plain(cell) for cell in row] for row in (table.columns, *table.rows)]
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return f"# {_plain(caption)}\n{stream.getvalue()}"


def _plain(text: str) -> str:
    return _BOLD.sub(r"\1", _CODE.sub(r"\1", " ".join(text.split())))


FORMATS: dict[str, Callable[[Table, str], str]] = {"tex": latex_table, "csv": csv_table}
"""Writers of a table and its caption, by the ending of their files."""


def write_tables(
    report: Report, regime: Callable[[Table], str], folder: Path, endings: tuple[str, ...]
) -> list[Path]:
    """Write every table of a report to a file of its own; return the paths.

    Args:
        regime: sentences that say what a table was measured on; they follow its title.
        endings: keys of :data:`FORMATS`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sections = [*([report.answer] if report.answer else []), *report.sections]
    paths = []
    tables = [(section, table) for section in sections for table in section.tables]
    for number, (section, table) in enumerate(tables, 1):
        title = ": ".join(dict.fromkeys(filter(None, (section.title, table.caption))))
        slug = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")[:60]
        for ending in endings:
            path = folder / f"{number:02}-{slug}.{ending}"
            write_atomic(path, FORMATS[ending](table, f"{title}. {regime(table)}").encode())
            paths.append(path)
    return paths
