"""Figures as SVG, with bytes that depend only on the numbers."""

from __future__ import annotations

import io
import itertools
import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from attnwarp_eval.document.numbers import FEWEST_SCENES, number, spread
from attnwarp_eval.files import write_atomic
from attnwarp_eval.statistics.intervals import Interval, front

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.axes import Axes

PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555", "#000000")
"""Okabe and Ito's colours, distinct for every type of colour vision."""

MARKERS = "osD^vP*X"

APART = 0.8
"""Degrees between the intervals of two lines over yaw."""


@contextmanager
def drawing(
    path: Path, columns: int = 1, height: float = 3.4, *, rows: int = 1, width: float | None = None
) -> Iterator[list[Axes]]:
    """A figure of ``rows`` x ``columns`` axes, row by row, saved as SVG on leaving without a date
    or random ids.

    Args:
        height, width: height and width of the whole figure, in inches; 5.4 a column if ``width`` is
            left out.

    Example:
        >>> from pathlib import Path
        >>> with drawing(Path("figure.svg"), columns=2) as axes:
        ...     len(axes)
        2
        >>> Path("figure.svg").stat().st_size > 1000
        True
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    style: dict[Any, Any] = {
        "svg.hashsalt": "attnwarp",
        "figure.dpi": 72,
        "font.size": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "grid.alpha": 0.25,
        "legend.frameon": False,
        "legend.fontsize": 8,
        "axes.formatter.min_exponent": 4,
    }
    with matplotlib.rc_context(style):
        figure, axes = pyplot.subplots(
            rows,
            columns,
            figsize=(width or 5.4 * columns, height),
            squeeze=False,
            layout="constrained",
        )
        yield list(axes.flat)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # names surround points, which must not move again
        for each in axes.flat:
            _place_names(each)
        buffer = io.BytesIO()
        # savefig would draw everything once more, for a layout that is done.
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
        pyplot.close(figure)
        write_atomic(path, _titled(buffer.getvalue().decode()).encode())


HOVER = "hover: "
"""Prefix of the id of an element with a tooltip, followed by the text."""


def hover(axes: Axes, x: float, y: float, text: str) -> None:
    """Give a point of a figure a tooltip.

    Example:
        >>> from pathlib import Path
        >>> with drawing(Path("figure.svg")) as (axes,):
        ...     hover(axes, 0.5, 0.5, "half & half")
        >>> "<title>half &amp; half</title>" in Path("figure.svg").read_text()
        True
    """
    # Not fully transparent: matplotlib would draw nothing, and nothing could be hovered.
    spot = axes.scatter([x], [y], s=110, color="#888888", alpha=0.004, linewidths=0, zorder=9)
    spot.set_gid(HOVER + text)


def _titled(svg: str) -> str:
    """The SVG with the texts of :func:`hover` as titles."""
    return re.sub(rf'<g id="{HOVER}([^"]*)">', r'<g class="hover"><title>\1</title>', svg)


@dataclass
class Line:
    """One line of a chart: y (with an optional interval) over x.

    Example:
        >>> from attnwarp_eval.statistics.intervals import interval
        >>> errors = [interval({"bear": [0.5]}), interval({"bear": [0.25]})]
        >>> line = Line("corrected", [16, 64], errors)
        >>> [value.mean for value in line.y]
        [0.5, 0.25]
    """

    name: str
    x: Sequence[float]
    y: Sequence[Interval]


def lines(
    axes: Axes,
    series: Sequence[Line],
    *,
    x: str,
    y: str,
    title: str,
    share: bool = False,
    log: bool = False,
    legend: bool = True,
    apart: float = 0.0,
) -> None:
    """Means with their intervals as bars; undefined points are left out. A ``share`` is drawn from
    0 to 1. Lines that share their x are shifted by ``apart``, in its unit, around their position.

    Example:
        >>> from pathlib import Path
        >>> from attnwarp_eval.statistics.intervals import interval
        >>> errors = [interval({"bear": [0.5]}), interval({"bear": [0.25]})]
        >>> line = Line("corrected", [16, 64], errors)
        >>> with drawing(Path("lines.svg")) as (axes,):
        ...     lines(axes, [line], x="size, px", y="error, px", title="Warp")
    """
    for i, line in enumerate(series):
        mean = np.array([v.mean for v in line.y])
        keep = np.isfinite(mean)
        if not keep.any():
            continue
        x_values = np.asarray(line.x, dtype=float)[keep]
        both = np.array([ends(v) for v in line.y])[keep]
        low, high = np.where(np.isfinite(both), both, mean[keep, None]).T
        shift = (i - (len(series) - 1) / 2) * apart
        bars = np.clip([mean[keep] - low, high - mean[keep]], 0, None)
        axes.errorbar(
            x_values + shift,
            mean[keep],
            yerr=bars,
            color=PALETTE[i % len(PALETTE)],
            marker=MARKERS[i % len(MARKERS)],
            markersize=4.5,
            linewidth=1.4,
            elinewidth=0.8,
            capsize=2,
            label=_plain(line.name),
        )
        for place, value in zip(line.x, line.y, strict=True):
            if np.isfinite(value.mean):
                hover(axes, place + shift, value.mean, f"{line.name}, {place:g}: {spread(value)}")
    axes.set(xlabel=_plain(x), ylabel=_plain(y))
    axes.set_title(_wrapped(title, 62), loc="left", fontsize=9.5)
    if log:
        axes.set_yscale("log")
    if share:
        axes.set_ylim(-0.03, 1.03)
    if legend:
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))


def _wrapped(text: str, width: int) -> str:
    """Plain text on lines of at most ``width`` characters, so that none is clipped at an edge."""
    return _plain("\n".join(textwrap.wrap(text, width)))


def _plain(text: str) -> str:
    """Escape dollars in a text; Matplotlib reads formulas between two."""
    return text.replace("$", r"\$")


MOST_NAMES = 12
"""Largest number of named points in a figure of a front; more names would cover one another's
bars."""


def cost_front(
    axes: Axes,
    points: Mapping[str, tuple[Interval, Interval]],
    *,
    x: str,
    y: str,
    title: str,
    log: bool = True,
) -> list[str]:
    """Error against seconds with intervals on both axes; the front as a staircase, dominated points
    in grey. With more than :data:`MOST_NAMES` points only those on the front have names; the others
    have tooltips. Return the names on the front, cheapest first.

    ``log``: whether the error's axis is logarithmic, as that of seconds always is.

    Example:
        >>> from pathlib import Path
        >>> from attnwarp_eval.statistics.intervals import interval
        >>> values = {"fast": (1.0, 0.5), "exact": (2.0, 0.1), "poor": (3.0, 0.4)}
        >>> points = {
        ...     name: (interval({"bear": [seconds]}), interval({"bear": [error]}))
        ...     for name, (seconds, error) in values.items()
        ... }
        >>> with drawing(Path("front.svg")) as (axes,):
        ...     cost_front(axes, points, x="seconds", y="error", title="Cost")
        ['fast', 'exact']
    """
    names = list(points)
    cost = [points[n][0].mean for n in names]
    error = [points[n][1].mean for n in names]
    on_front = front(cost, error)
    known = np.isfinite(cost) & np.isfinite(error)
    crowded = known.sum() > MOST_NAMES
    for i, name in enumerate(names):
        seconds, quality = points[name]
        if not known[i]:
            continue
        on = i in on_front
        colour = PALETTE[0] if on else "#999999"
        axes.errorbar(
            seconds.mean,
            quality.mean,
            color=colour,
            marker="o" if on else "x",
            markersize=5,
            linewidth=0,
            elinewidth=0.8,
            capsize=2,
            xerr=_bars(seconds, True),
            yerr=_bars(quality, log),
            zorder=3 if on and crowded else 2,
        )
        if on or not crowded:
            axes.annotate(
                _plain(name),
                (seconds.mean, quality.mean),
                textcoords="offset points",
                xytext=SPOTS[0],
                fontsize=7.5,
                color=colour,
                bbox={"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 0.5},
                arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.6},
                zorder=5,
            ).set_in_layout(False)
        text = f"{name}: {spread(quality)} in {number(1000 * seconds.mean)} ms"
        hover(axes, seconds.mean, quality.mean, text)
    if on_front:
        axes.plot(
            np.repeat([cost[i] for i in on_front], 2)[1:],
            np.repeat([error[i] for i in on_front], 2)[:-1],
            color=PALETTE[0],
            linewidth=1,
            alpha=0.6,
        )
    axes.set(
        xlabel=_plain(x), ylabel=_wrapped(y, 40), xscale="log", yscale="log" if log else "linear"
    )
    axes.set_title(_wrapped(title, 62), loc="left", fontsize=9.5)
    axes.margins(0.2)
    return [names[i] for i in on_front]


SPOTS = [(5.0, 5.0)] + [
    (radius * math.cos(angle), radius * math.sin(angle))
    for radius in np.linspace(7, 190, 40)
    for angle in np.linspace(0, 2 * math.pi, 24, endpoint=False)
]
"""Offsets from a point at which its name may begin or end, in 1/72 inch, nearest first."""


def _place_names(axes: Axes) -> None:
    """Put each name at the free spot nearest to its point: inside the axes, over no other name and,
    if there is room, over no point and no bar. A line leads to a name that is far away.
    """
    from matplotlib.text import Annotation, Text
    from matplotlib.transforms import Bbox

    figure = axes.get_figure(root=True)
    assert figure is not None
    notes = [text for text in axes.texts if isinstance(text, Annotation)]
    scale, frame = figure.dpi / 72, axes.get_window_extent()
    places = axes.transData.transform([note.xy for note in notes] or np.empty((0, 2)))
    strokes = np.concatenate([np.empty((0, 2)), *_strokes(axes)])
    settled: list[Bbox] = []
    # The rightmost names have the fewest options.
    for note, (x, y) in sorted(zip(notes, places, strict=True), key=lambda pair: -pair[1][0]):
        width, height = Text.get_window_extent(note).size
        least, best = math.inf, Bbox.null()
        for across, up in SPOTS:
            if math.hypot(across, up) >= least:
                break
            left = x + across * scale - width * (0.5 if abs(across) < 1 else across < 0)
            box = Bbox.from_bounds(left, y + up * scale - height * (up < 0), width, height)
            near = box.padded(2 * scale)
            inside = frame.x0 <= box.x0 and box.x1 <= frame.x1
            inside = inside and frame.y0 <= box.y0 and box.y1 <= frame.y1
            cost = math.hypot(across, up) + 10 * near.count_contains(places)
            cost += near.count_contains(strokes)
            cost += 1000 * (near.count_overlaps(settled) + (not inside))
            if cost < least:
                least, best = cost, box
        note.xyann = ((best.x0 - x) / scale, (best.y0 - y) / scale)
        settled.append(best)
        assert note.arrow_patch is not None
        apart = math.hypot(*np.clip((x, y), best.min, best.max) - (x, y)) > 12 * scale
        note.arrow_patch.set_visible(apart)


def _strokes(axes: Axes) -> Iterator[npt.NDArray[np.float64]]:
    """Points along every bar and line, in pixels."""
    from matplotlib.container import ErrorbarContainer

    steps = np.linspace(0, 1, 40)[:, None]
    errors = [each for each in axes.containers if isinstance(each, ErrorbarContainer)]
    bars = [bar for each in errors for bar in each.lines[2]]
    paths = [path for bar in bars for path in bar.get_segments()]
    for path in [*paths, *(line.get_xydata() for line in axes.lines)]:
        corners = axes.transData.transform(path)
        for start, end in itertools.pairwise(corners):
            yield start + steps * (end - start)


def ends(value: Interval) -> tuple[float, float]:
    """Ends of a bar: of the interval, or with few scenes the lowest and the highest scene.

    Example:
        >>> from attnwarp_eval.statistics.intervals import interval
        >>> ends(interval({"bear": [1.0], "fence": [1.1], "glass": [0.9]}))
        (0.9, 1.1)
    """
    few = value.scenes < FEWEST_SCENES and math.isfinite(value.least)
    return (value.least, value.most) if few else (value.low, value.high)


def _bars(value: Interval, log: bool) -> list[list[float]] | None:
    low, high = ends(value)
    if not (math.isfinite(low) and math.isfinite(high)):
        return None
    # A bar that crosses zero is clipped just above zero on a logarithmic axis.
    low = max(low, value.mean / 20) if log else low
    return [[max(value.mean - low, 0.0)], [max(high - value.mean, 0.0)]]
