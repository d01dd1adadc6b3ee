"""Content of a report, independent of its output format: sections of text, tables, figures and
pictures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path


class Marked(str):
    """Cell of a table in the colour of its verdict, a class of the page's style.

    Example:
        >>> cell = Marked("1.25 ± 0.20 worse", "worse")
        >>> cell.verdict, cell.startswith("1.25")
        ('worse', True)
    """

    verdict: str

    def __new__(cls, text: str, verdict: str) -> Marked:
        """Mark a text."""
        cell = super().__new__(cls, text)
        cell.verdict = verdict
        return cell


@dataclass
class Table:
    """A table of ready-made text cells; those that hold more than a verdict's word, and have its
    colour, are :class:`Marked`.

    Columns named in ``timed`` hold seconds or memory. A ``folded`` table is collapsed on a page
    until a reader opens it, and is left out of short Markdown. In a ``glossary`` the first column
    has terms that the others explain, and the same terms elsewhere on the page link to it.

    Example:
        >>> table = Table(["variant", "seconds"], [["paper", "0.1"]], timed=("seconds",))
        >>> table.without_timings().columns
        ['variant']
    """

    columns: list[str]
    rows: list[list[str]]
    caption: str = ""
    timed: tuple[str, ...] = ()
    folded: bool = False
    glossary: bool = False

    def without_timings(self) -> Table:
        """Copy of the table without its columns of seconds and memory."""
        keep = [i for i, name in enumerate(self.columns) if name not in self.timed]
        rows = [[row[i] for i in keep] for row in self.rows]
        columns = [self.columns[i] for i in keep]
        return replace(self, columns=columns, rows=rows, timed=())


@dataclass
class Picture:
    """An image file of the run's folder, with a caption, and a command that explains it.

    Example:
        >>> Picture("pictures/a.png", "the source").caption
        'the source'
    """

    path: str
    caption: str
    command: str = ""


@dataclass
class Slider:
    """Two pictures of one size laid over each other, with a handle that uncovers the second.

    Example:
        >>> slider = Slider(Picture("a.png", "mask, baseline"), Picture("b.png", "mask, run"))
        >>> slider.caption
        'mask, baseline | mask, run'
    """

    before: Picture
    after: Picture

    @property
    def caption(self) -> str:
        """Captions of the pictures on the left and on the right of the handle."""
        return f"{self.before.caption} | {self.after.caption}"


@dataclass
class Gallery:
    """Pictures in rows: a line of text, then pictures or sliders side by side.

    With ``picker``, a bold row heads the rows of one view, and on a page a reader overlays any two
    pictures of a view. ``commands`` come before the pictures in plain text; on a page each picture
    has a separate one.

    Example:
        >>> gallery = Gallery([("yaw 30", [Picture("a.png", "truth"), Picture("b.png", "warp")])])
        >>> [len(pictures) for _, pictures in gallery.rows]
        [2]
    """

    rows: Sequence[tuple[str, Sequence[Picture | Slider]]]
    picker: bool = False
    commands: Sequence[str] = ()


@dataclass
class Grid:
    """Pictures side by side: columns are views, rows variants, all named; None if missing.

    Example:
        >>> grid = Grid("An edit", ["yaw 30"], [("before", [Picture("a.png", "before, yaw 30")])])
        >>> [label for label, _ in grid.rows]
        ['before']
    """

    caption: str
    columns: list[str]
    rows: list[tuple[str, list[Picture | None]]]

    @classmethod
    def of(
        cls,
        caption: str,
        columns: Sequence[str],
        rows: Iterable[tuple[str, Sequence[Path | str | None]]],
    ) -> Grid:
        """Grid of files: each row a label and a path for each column, None if missing."""
        pictures = [
            (
                label,
                [
                    None if path is None else Picture(str(path), f"{label}, {column}")
                    for path, column in zip(paths, columns, strict=True)
                ],
            )
            for label, paths in rows
        ]
        return cls(caption, list(columns), pictures)


@dataclass
class Section:
    """A heading with text, grids, tables, figures and galleries, in this order.

    A ``folded`` section is collapsed until a reader opens it, and is left out of short Markdown.
    One that ``leads`` comes right after a report's answer.

    Example:
        >>> section = Section("Depth", ["Against exact depth."], [Table(["AbsRel"], [["0.01"]])])
        >>> section.title, section.figures
        ('Depth', [])
    """

    title: str
    text: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    figures: list[Picture] = field(default_factory=list)
    gallery: Gallery | None = None
    folded: bool = False
    leads: bool = False
    grids: list[Grid] = field(default_factory=list)


@dataclass
class Report:
    """The whole report: its answer, if any, before everything else.

    Example:
        >>> from attnwarp_eval.document.write import markdown
        >>> markdown(Report("Warps", ["Two views."], [Section("Depth")])).splitlines()[0]
        '# Warps'
    """

    title: str
    lead: list[str]
    sections: list[Section]
    answer: Section | None = None
