"""Results on a bench, one JSON file a method, and tables that compare them.

A track has one order, fixed before any method was scored:

- same editor (one of ours, so that all right answers are known): ``error``, the mean CIEDE2000 over
  all pixels of all views to the right answer that the source's picture is nearest to. Another right
  answer in a view is an error there, so is what leaks outside the mask, and a missing view counts
  as unedited.
- own editor: ``apart``, disagreement above the floor plus change outside the mask. Pictures that
  are unedited, copied or smoothed agree without any merit: a remark names them, and ``apart`` is
  undefined. A method with such a scene stands behind those without.

Less is better in both.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator
from pydantic.dataclasses import dataclass

from attnwarp.errors import InputError
from attnwarp.io.text import read_text
from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.document.model import Report, Section, Table
from attnwarp_eval.files import write_atomic
from attnwarp_eval.statistics.intervals import Interval, interval, paired

PROTOCOL = 2
"""Version; raised when equal pictures would get other scores."""

SAME, OWN = "same editor", "own editor"

FIGURES = {
    "error": "error, dE00",
    "apart": "disagreement + outside, dE00",
    "amount": "change of the source, dE00",
    "done": "edits done",
    "agreement": "disagreement above the floor, dE00",
    "seen": "the source's answer where it sees",
    "outside": "change outside, dE00",
    "drift": "drift, px",
    "render_error": "error of the splats, dE00",
}
"""Figures by key, with their heads."""

ORDER = {SAME: "error", OWN: "apart"}
"""Figure that orders the methods of each track."""

Figure = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
_STRICT = ConfigDict(extra="forbid", allow_inf_nan=True)


@dataclass(frozen=True, config=_STRICT)
class Score:
    """Score of one edit of one scene.

    Attributes:
        scene, edit: names.
        figures: values of :data:`FIGURES`; NaN if undefined.
        by_view: figures of each target in the names of studies, such as
            ``fidelity.psnr.edit_inside``.
        remarks: faults of the pictures, in words.
    """

    scene: str
    edit: str
    figures: dict[Literal[*FIGURES], Figure]  # type: ignore[valid-type]
    by_view: dict[str, dict[str, Figure]]
    remarks: list[str]

    @field_validator("figures")
    @classmethod
    def _complete(cls, figures: dict[str, float]) -> dict[str, float]:
        if missing := [name for name in FIGURES if name not in figures]:
            raise ValueError(f"lacks {', '.join(missing)}")
        return figures


class Method(BaseModel):
    """Declaration of a method, as in a folder's ``method.json``.

    ``seconds`` for all edits, as declared. ``editor_sha256`` and ``settings`` are written by
    ``attnwarp-eval bench run``.
    """

    model_config = ConfigDict(extra="forbid")

    name: str = "the pictures"
    editor: str = ""
    track: Literal["same editor", "own editor"] = "own editor"
    seconds: float | None = Field(default=None, ge=0)
    url: str = ""
    editor_sha256: str = ""
    settings: dict[str, Any] = Field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> Method:
        """Read a ``method.json``; the defaults without one.

        Raises:
            InputError: an unknown key or a value of another kind.
        """
        return _validated(cls, path) if path.is_file() else cls()


class Result(BaseModel):
    """Result of a method: the file that a table has of it.

    ``bench`` has what decides the scenes: generator, seed, size, samples, views, salted hashes.
    """

    model_config = ConfigDict(extra="forbid")

    protocol: Literal[2]
    bench: dict[str, Any]
    method: Method
    scores: list[Score] = Field(min_length=1)
    missing: list[str]

    @classmethod
    def read(cls, path: Path) -> Result:
        """Read a ``bench-score.json``.

        Raises:
            InputError: no such file, or of another format.
        """
        return _validated(cls, path)

    def write(self, path: Path) -> None:
        """Write as JSON, undefined figures as null."""
        data = self.model_dump() | {"scores": [without_nan(asdict(s)) for s in self.scores]}
        text = json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        write_atomic(path, text.encode())

    @property
    def edits(self) -> list[str]:
        """Names of the scored edits."""
        return list(dict.fromkeys(score.edit for score in self.scores))

    def values(self, edit: str, figure: str) -> dict[str, float]:
        """A figure by scene."""
        return {s.scene: s.figures[figure] for s in self.scores if s.edit == edit}


def _validated(kind: Any, path: Path) -> Any:
    try:
        return kind.model_validate_json(read_text(path))
    except FileNotFoundError:
        raise InputError(f"{path}: is missing; make it with attnwarp-eval bench score") from None
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the file"
        raise InputError(f"{path}: {place}: {first['msg']}; see docs/measuring/bench.md") from None


def bounded(value: Interval, sign: str = "") -> str:
    """A mean with its interval, if it has one; empty if undefined."""
    if math.isnan(value.mean):
        return ""
    low, high = (format(v, f"{sign}.2f") for v in (value.low, value.high))
    return format(value.mean, f"{sign}.2f") + (f" [{low}, {high}]" if value.bounded else "")


def table(scores: Sequence[Score]) -> Table:
    """The figures by edit: means over scenes with their 95 % interval."""
    rows = []
    for edit in dict.fromkeys(score.edit for score in scores):
        own = [score for score in scores if score.edit == edit]
        cells = [bounded(interval({s.scene: [s.figures[name]] for s in own})) for name in FIGURES]
        rows.append([edit, str(len(own)), *cells])
    return Table(["edit", "scenes", *FIGURES.values()], rows)


def compare(results: Sequence[Result]) -> Report:
    """Compare methods on one bench, in each track and edit; the first is paired with the others.

    Raises:
        ValueError: results of two benches.
    """
    first = results[0]
    for result in results:
        if result.bench != first.bench:
            raise ValueError(
                f"{result.method.name}: was scored on another bench than {first.method.name};"
                " score both on one"
            )
    sections = [
        Section(f"{track.capitalize()}: {edit}", tables=[_compared(results, first, track, edit)])
        for track in ORDER
        for edit in first.edits
        if any(result.method.track == track for result in results)
    ]
    remarks = [
        f"- {r.method.name}, {r.method.editor}: {s.scene}, {s.edit}: {text}"
        for r in results
        for s in r.scores
        for text in s.remarks
    ]
    of = first.bench
    lead = [
        f"Drawn scenes of generator {of['generator']}, "
        + (f"seed {of['seed']}" if of["seed"] is not None else "sealed")
        + f", {len(of['views'])} views of {of['size']} px. Means over scenes with their 95 %"
        f" intervals; the last column is the method minus {first.method.name} with"
        f" {first.method.editor}, paired by scene. Less is better; disagreement is read beside the"
        " change of the source."
    ]
    if remarks:
        sections.append(Section("Remarks", ["\n".join(remarks)]))
    return Report("Methods on a bench", lead, sections)


def _compared(results: Sequence[Result], first: Result, track: str, edit: str) -> Table:
    figure = ORDER[track]
    keys = [figure, *(key for key in FIGURES if key not in ORDER.values())]
    ranked = []
    for result in results:
        if result.method.track != track or edit not in result.edits:
            continue
        values = result.values(edit, figure)
        means = [bounded(_over(result.values(edit, key))) for key in keys]
        gain = "" if result is first else bounded(
            paired(_by_scene(first.values(edit, figure)), _by_scene(values)), "+"
        )  # fmt: skip
        seconds = "" if result.method.seconds is None else f"{result.method.seconds:.0f}"
        row = [result.method.name, result.method.editor, str(len(values)), *means, seconds, gain]
        undefined = any(math.isnan(value) for value in values.values())
        ranked.append((undefined, _over(values).mean, row))
    ranked.sort(key=lambda one: (one[0], math.isnan(one[1]), one[1]))
    heads = [FIGURES[key] for key in keys]
    columns = ["method", "editor", "scenes", *heads, "seconds", f"{figure}, difference"]
    return Table(columns, [row for *_, row in ranked], timed=("seconds",))


def _over(values: Mapping[str, float]) -> Interval:
    return interval({scene: [value] for scene, value in values.items()})


def _by_scene(values: Mapping[str, float]) -> dict[str, dict[str, float]]:
    return {scene: {"": value} for scene, value in values.items()}
