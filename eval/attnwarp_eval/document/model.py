"""A report's content, apart from how it is written: sections of text, tables, figures and
pictures."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Table:
    """A table of ready-made text cells.

    Columns named in ``timed`` hold seconds or memory. A ``folded`` table is closed on a page until
    a reader opens it.

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

    def without_timings(self) -> Table:
        """The same table without its columns of seconds and memory."""
        keep = [i for i, name in enumerate(self.columns) if name not in self.timed]
        rows = [[row[i] for i in keep] for row in self.rows]
        return Table([self.columns[i] for i in keep], rows, self.caption, folded=self.folded)


@dataclass
class Picture:
    """An image file of the run's folder, with what it shows.

    Example:
        >>> Picture("pictures/a.png", "the source").caption
        'the source'
    """

    path: str
    caption: str


@dataclass
class Gallery:
    """Pictures in rows: a line of text, then pictures side by side.

    Example:
        >>> gallery = Gallery([("yaw 30", [Picture("a.png", "truth"), Picture("b.png", "warp")])])
        >>> [len(pictures) for _, pictures in gallery.rows]
        [2]
    """

    rows: list[tuple[str, list[Picture]]]


@dataclass
class Section:
    """A heading with text, tables, figures and galleries, in this order.

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


@dataclass
class Report:
    """The whole report.

    Example:
        >>> from attnwarp_eval.document.write import markdown
        >>> markdown(Report("Warps", ["Two views."], [Section("Depth")])).splitlines()[0]
        '# Warps'
    """

    title: str
    lead: list[str]
    sections: list[Section]
