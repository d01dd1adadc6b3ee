"""A report as Markdown and as one self-contained HTML file."""

from __future__ import annotations

import base64
import html
import mimetypes
import re
from pathlib import Path
from typing import TYPE_CHECKING

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from attnwarp_eval.document.model import Report, Table

if TYPE_CHECKING:
    import rich.table

_CLASSES = {
    "seen": "holds",
    "not seen": "fails",
    "better": "better",
    "worse": "worse",
    "holds": "holds",
    "does not hold": "fails",
    "FAILED": "fails",
}


def inline(text: str) -> Markup:
    """Escaped text in which `code`, **bold** and `#rrggbb` (a swatch of that colour) have been
    set.

    Example:
        >>> print(inline("`a` < **b**"))
        <code>a</code> &lt; <strong>b</strong>
    """
    escaped = html.escape(text, quote=False)
    escaped = re.sub(
        r"`(#[0-9a-f]{6})`", r'<span class="swatch" style="background:\1"></span>', escaped
    )
    escaped = re.sub(r"`([^`]+)`", r"<code>\1</code>", escaped)
    return Markup(re.sub(r"\*\*([^*]+)\*\*", r"<strong>\1</strong>", escaped))


def _css(cell: str) -> Markup:
    if cell in _CLASSES:
        return Markup(f' class="{_CLASSES[cell]}"')
    return Markup(' class="wide"') if len(cell) > 40 else Markup("")


def _embedder(root: Path):  # type: ignore[no-untyped-def]
    def embed(path: str) -> str:
        kind = mimetypes.guess_type(path)[0] or "application/octet-stream"
        return f"data:{kind};base64,{base64.b64encode((root / path).read_bytes()).decode()}"

    return embed


def plain(text: str) -> str:
    """Markdown text in which names cannot begin a tag, and code stays as it is.

    Example:
        >>> plain("fog < 2 px, `a<b`, <b>")
        'fog < 2 px, `a<b`, &lt;b>'
    """
    return _TAG.sub(lambda match: match[1] or "&lt;", text)


_TAG = re.compile(r"(`[^`]*`)|<(?=[A-Za-z/!?])")
"""Code, in which nothing is a tag, or the beginning of one."""


def terminal(table: Table) -> rich.table.Table:
    """A table for a terminal; its cells are plain text, without markup.

    Example:
        >>> terminal(Table(["variant", "AbsRel"], [["paper", "0.01"]])).row_count
        1
    """
    import rich.table
    from rich.text import Text

    grid = rich.table.Table(*table.columns, caption=table.caption or None)
    for row in table.rows:
        grid.add_row(*map(Text, row))
    return grid


def markdown(report: Report) -> str:
    """The report as Markdown; pictures are links relative to the run's folder.

    Example:
        >>> from attnwarp_eval.document.model import Section
        >>> table = Table(["variant", "AbsRel"], [["paper", "0.01"]])
        >>> text = markdown(Report("Warps", [], [Section("Depth", tables=[table])]))
        >>> "| paper | 0.01 |" in text
        True
    """
    environment = Environment(
        loader=PackageLoader("attnwarp_eval.document", "."),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
        autoescape=False,
    )
    environment.filters["plain"] = plain
    text = environment.get_template("report.md.j2").render(report=report)
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"


def page(report: Report, root: Path) -> str:
    """The report as one HTML file with every picture inside it.

    Example:
        >>> from pathlib import Path
        >>> from attnwarp_eval.document.model import Section
        >>> text = page(Report("Warps & views", [], [Section("Depth")]), Path())
        >>> "<title>Warps &amp; views</title>" in text
        True
    """
    environment = Environment(
        loader=PackageLoader("attnwarp_eval.document", "."),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
        autoescape=True,
    )
    environment.filters.update(inline=inline, css=_css, embed=_embedder(root))
    return environment.get_template("report.html.j2").render(report=report) + "\n"
