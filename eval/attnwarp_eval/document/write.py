"""A report as Markdown and as one self-contained HTML file."""

from __future__ import annotations

import base64
import functools
import html
import io
import itertools
import math
import mimetypes
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from attnwarp.io.picture import encode_picture
from attnwarp_eval.document.model import Gallery, Marked, Picture, Report, Slider, Table
from attnwarp_eval.files import write_atomic

if TYPE_CHECKING:
    import rich.table

_CLASSES = {
    "seen": "holds",
    "seen where defined": "holds",
    "not seen": "fails",
    "better": "better",
    "worse": "worse",
    "holds": "holds",
    "does not hold": "fails",
    "FAILED": "fails",
}


def inline(text: str) -> Markup:
    """Escaped text in which `code`, **bold** and `#rrggbb` (a swatch of that colour) are
    rendered.

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


def _block(text: str) -> Markup:
    """A paragraph, or a list if the text begins with a dash."""
    if not text.startswith("- "):
        return Markup("<p>{}</p>").format(inline(text))
    items = text.removeprefix("- ").split("\n- ")
    return Markup("<ul>{}</ul>").format(
        Markup().join(Markup("<li>{}</li>").format(inline(item)) for item in items)
    )


def _css(cell: str) -> Markup:
    marked = cell.verdict if isinstance(cell, Marked) else _CLASSES.get(cell)
    if marked:
        return Markup(f' class="{marked}"')
    if len(cell) > 40:
        return Markup(' class="wide"')
    return Markup(' class="text"') if len(cell) > 12 and cell[0].isalpha() else Markup("")


LARGEST = 5_400_000
"""Bytes of a page's pictures; with a third more as base64 and the rest, a page has at most 8 MB."""


def _pictures(report: Report) -> set[str]:
    """The files of all pictures of a report."""
    entries: list[Picture | Slider] = []
    for section in [*([report.answer] if report.answer else []), *report.sections]:
        entries += [entry for _, row in (section.gallery or Gallery([])).rows for entry in row]
        for grid in section.grids:
            entries += [entry for _, row in grid.rows for entry in row if entry is not None]
    return {
        picture.path
        for entry in entries
        for picture in ([entry.before, entry.after] if isinstance(entry, Slider) else [entry])
    }


def _embedder(report: Report, root: Path) -> Callable[[str], str]:
    """Return the function that embeds a file into the page; pictures are scaled down if all are
    too large.
    """
    pictures = _pictures(report)
    scale = reduction(sum((root / path).stat().st_size for path in pictures))

    @functools.cache
    def embed(path: str) -> str:
        kind = mimetypes.guess_type(path)[0] or "application/octet-stream"
        data = (root / path).read_bytes()
        if path in pictures and scale < 1:
            kind, data = "image/jpeg", reduced(data, scale)
        return f"data:{kind};base64,{base64.b64encode(data).decode()}"

    return embed


def reduction(total: int) -> float:
    """Scale of the sides of a page's pictures, ``total`` bytes in all; 1 to keep them.

    Example:
        >>> reduction(LARGEST), reduction(4 * LARGEST)
        (1.0, 0.45)
    """
    return min(1.0, 0.9 * math.sqrt(LARGEST / total)) if total > LARGEST else 1.0


def reduced(data: bytes, scale: float) -> bytes:
    """A picture's file with its sides scaled, as JPEG.

    Example:
        >>> import numpy as np
        >>> from attnwarp.io.picture import encode_picture
        >>> data = encode_picture(np.zeros((32, 32, 3), np.uint8), ".png")
        >>> reduced(data, 0.5)[:2].hex()  # where every JPEG begins
        'ffd8'
    """
    from PIL import Image

    with Image.open(io.BytesIO(data)) as picture:
        size = (max(1, round(scale * picture.width)), max(1, round(scale * picture.height)))
        smaller = picture.convert("RGB").resize(size, Image.Resampling.BOX)
    return encode_picture(np.asarray(smaller), ".jpg", chroma="420")


def _drawer(root: Path) -> Callable[[str], Markup]:
    """Return the function that embeds a figure into the page as SVG, with ids that no other figure
    has.
    """
    count = itertools.count(1)

    def draw(path: str) -> Markup:
        own = f"f{next(count)}-"
        svg = (root / path).read_text(encoding="utf-8")
        svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.S)
        svg = re.sub(r'\bid="', f'id="{own}', svg)
        return Markup(re.sub(r'((?:xlink:)?href="|url\()#', rf"\1#{own}", svg))

    return draw


def _linker(report: Report) -> Callable[[str], Markup]:
    """Return the function that writes a cell of a table; names of metrics link to their meaning."""
    names = {
        row[0]
        for section in report.sections
        for t in section.tables
        if t.glossary
        for row in t.rows
    }

    def cell(text: str) -> Markup:
        name = text if text in names else ".".join(text.split(".")[:2])
        if name in names and " " not in text:
            return Markup('<a href="#m-{}">{}</a>').format(name, inline(text))
        return inline(text)

    return cell


def plain(text: str) -> str:
    """Markdown text in which names cannot begin a tag, and code stays as it is.

    Example:
        >>> plain("fog < 2 px, `a<b`, <b>")
        'fog < 2 px, `a<b`, &lt;b>'
    """
    return _TAG.sub(lambda match: match[1] or "&lt;", text)


_TAG = re.compile(r"(`[^`]*`)|<(?=[A-Za-z/!?])")
"""Inline code, or the beginning of a tag."""


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


def markdown_table(table: Table) -> str:
    """The rows of a table in Markdown.

    Example:
        >>> print(markdown_table(Table(["variant", "AbsRel"], [["paper", "0.01"]])))
        | variant | AbsRel |
        |---|---|
        | paper | 0.01 |
    """
    lines = [
        # A row is one line, but error texts may have several.
        " | ".join(plain(" ".join(cell.splitlines()).replace("|", "\\|")) for cell in cells)
        for cells in (table.columns, *table.rows)
    ]
    header, *rows = (f"| {line} |" for line in lines)
    return "\n".join([header, f"|{'---|' * len(table.columns)}", *rows])


def templates(package: str, *, autoescape: bool) -> Environment:
    """Load the templates next to a package's modules; an undefined name is an error.

    Example:
        >>> templates("attnwarp_eval.document", autoescape=True).list_templates("j2")
        ['report.html.j2', 'report.md.j2']
    """
    return Environment(
        loader=PackageLoader(package, "."),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
        autoescape=autoescape,
    )


def _render(
    template: str, report: Report, autoescape: bool, filters: dict[str, Any], long: bool = True
) -> str:
    environment = templates("attnwarp_eval.document", autoescape=autoescape)
    environment.filters.update(filters)
    return environment.get_template(template).render(report=report, long=long)


def markdown(report: Report, *, long: bool = True) -> str:
    """The report as Markdown; pictures are links relative to the run's folder, and come last, since
    a CI's summary shows none.

    Args:
        long: False leaves out folded sections and tables.

    Example:
        >>> from attnwarp_eval.document.model import Section
        >>> table = Table(["variant", "AbsRel"], [["paper", "0.01"]])
        >>> text = markdown(Report("Warps", [], [Section("Depth", tables=[table])]))
        >>> "| paper | 0.01 |" in text
        True
    """
    filters = {"plain": plain, "table": markdown_table}
    text = _render("report.md.j2", report, False, filters, long)
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
    filters: dict[str, Any] = {"inline": inline, "block": _block, "css": _css}
    filters |= {"cell": _linker(report), "embed": _embedder(report, root), "draw": _drawer(root)}
    return _render("report.html.j2", report, True, filters) + "\n"


def write_files(report: Report, folder: Path, name: str, *, long: bool = True) -> list[Path]:
    """Write the report as Markdown and as a page, see :func:`markdown`; return their paths.

    Example:
        >>> from pathlib import Path
        >>> [path.name for path in write_files(Report("Warps", [], []), Path(), "warps")]
        ['warps.md', 'warps.html']
    """
    texts = {f"{name}.md": markdown(report, long=long), f"{name}.html": page(report, folder)}
    for file, text in texts.items():
        write_atomic(folder / file, text.encode())
    return [folder / file for file in texts]
