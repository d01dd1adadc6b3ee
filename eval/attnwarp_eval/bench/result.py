"""Results on a bench, one JSON file a method, and tables that compare them.

Each track has one order, less is better:

- same editor (one of ours) and own editor: ``error``, the mean CIEDE2000 of all views to the right
  answer that the source's picture is nearest to, inside the mask plus outside. Another right answer
  in a view is an error there, and a missing view counts as unedited. Beside it stands ``apart``:
  how far the views' disagreement is from that of the true edited views, more or less.
- warps: ``wrong``, what is accepted wrongly or not kept, see
  :func:`attnwarp_eval.bench.warps.figures`. A missing view has no answer anywhere, which is 1.

So the truth is first, and copies are not. Who lacks a scene that another has stands behind.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
)
from pydantic.dataclasses import dataclass

from attnwarp.errors import InputError
from attnwarp_eval.canonical_json import read_as, without_nan
from attnwarp_eval.document.model import Report, Section, Table
from attnwarp_eval.document.numbers import FEWEST_SCENES, bracketed
from attnwarp_eval.files import write_atomic
from attnwarp_eval.statistics.contrasts import paired
from attnwarp_eval.statistics.intervals import Interval, interval

PROTOCOL: Final = 3
"""Version; raised when equal pictures would get other scores."""

SAME: Final = "same editor"
OWN: Final = "own editor"
WARPS: Final = "warps"

FIGURES = {
    "error": "error, dE00",
    "apart": "disagreement, less or more than the truth's, dE00",
    "amount": "change of the source, dE00",
    "done": "edits done",
    "agreement": "disagreement above the floor, dE00",
    "seen": "the source's answer where it sees",
    "outside": "change outside, dE00",
    "drift": "drift, px",
    "render_error": "error of the splats, dE00",
}
"""Figures of an edit by key, with their heads."""

WARP_FIGURES = {
    "wrong": "wrong or not kept",
    "warp.epe_median": "median end-point error, px",
    "warp.epe_p95": "its 95th percentile, px",
    "warp.below_1px": "visible within 1 px",
    "warp.coverage": "visible with a position",
    "occlusion.recall": "visible kept",
    "occlusion.hidden_share": "hidden, of what is kept",
    "occlusion.precision": "visible, of what is kept",
}
"""Figures of warps by key, with their heads."""

SHARES = ("done", "seen")

ORDER = {SAME: "error", OWN: "error", WARPS: "wrong"}
"""Figure that orders the methods of each track."""

FloatOrNull = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
_STRICT = ConfigDict(extra="forbid", allow_inf_nan=True)


@dataclass(frozen=True, config=_STRICT)
class Score:
    """Score of one edit of one scene, or of its warps.

    Attributes:
        scene, edit: names; the edit of warps is :data:`WARPS`.
        figures: values of :func:`heads_of` the edit; NaN if undefined.
        by_view: figures of each target in the names of studies, such as
            ``fidelity.psnr.edit_inside``.
        remarks: faults of what was handed in, in words.
    """

    scene: str
    edit: str
    figures: dict[str, FloatOrNull]
    by_view: dict[str, dict[str, FloatOrNull]]
    remarks: list[str]

    @field_validator("figures")
    @classmethod
    def _complete(cls, figures: dict[str, float], info: ValidationInfo) -> dict[str, float]:
        heads = heads_of(info.data.get("edit", ""))
        if missing := [name for name in heads if name not in figures]:
            raise ValueError(f"lacks {', '.join(missing)}")
        return figures


def heads_of(edit: str) -> dict[str, str]:
    """Heads of an edit's figures by their keys."""
    return WARP_FIGURES if edit == WARPS else FIGURES


def mean(values: Iterable[float]) -> float:
    """Mean of the defined values; NaN without any."""
    defined = [value for value in values if not math.isnan(value)]
    return float(np.mean(defined)) if defined else math.nan


class Method(BaseModel):
    """Declaration of a method, as in a folder's ``method.json``.

    ``name`` is the folder's, unless declared; ``seconds`` for all edits, as declared.
    ``editor_sha256``, ``settings`` and ``bench``, the SHA-256 of its bench.json, are written by
    ``attnwarp-eval bench run``.
    """

    model_config = ConfigDict(extra="forbid")

    name: str = ""
    editor: str = ""
    track: Literal["same editor", "own editor", "warps"] = "own editor"
    seconds: float | None = Field(default=None, ge=0)
    url: str = ""
    editor_sha256: str = ""
    settings: dict[str, Any] = Field(default_factory=dict)
    bench: str = ""

    @classmethod
    def read(cls, path: Path) -> Method:
        """Read a ``method.json``; the defaults without one.

        Raises:
            InputError: an unknown key or a value of another kind.
        """
        remedy = "mend or remove it; docs/measuring/bench.md has its keys"
        return read_as(cls, path, remedy) if path.is_file() else cls()

    def begun(self, out: Path) -> Method:
        """Write the declaration to a folder to hand in; return the one that is there already.

        Raises:
            InputError: the folder has files of another method or bench.
        """
        path = out / "method.json"
        if not path.is_file():
            self.write(out)
            return self
        before = Method.read(path)
        if before.model_copy(update={"seconds": self.seconds}) != self:
            raise InputError(f"{out}: has files of another method or bench; name another folder")
        return before

    def write(self, out: Path) -> None:
        """Write as the folder's ``method.json``."""
        write_atomic(out / "method.json", self.model_dump_json(indent=1).encode())


class Result(BaseModel):
    """Result of a method: the file that a table has of it.

    ``bench`` has what decides the scenes: generator, seed, size, samples, views.
    """

    model_config = ConfigDict(extra="forbid")

    protocol: Literal[3]
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
        return read_as(cls, path, "make it with attnwarp-eval bench score")

    def write(self, path: Path) -> None:
        """Write as JSON, undefined figures as null."""
        data = self.model_dump() | {"scores": [without_nan(asdict(s)) for s in self.scores]}
        text = json.dumps(data, ensure_ascii=False, allow_nan=False) + "\n"
        write_atomic(path, text.encode())

    @property
    def remarks(self) -> list[str]:
        """Faults of what was handed in, by scene and edit, and what was not handed in."""
        said = [f"{s.scene}, {s.edit}: {text}" for s in self.scores for text in s.remarks]
        return said + ([f"not handed in: {', '.join(self.missing)}"] if self.missing else [])

    @property
    def edits(self) -> list[str]:
        """Names of the scored edits."""
        return list(dict.fromkeys(score.edit for score in self.scores))

    def values(self, edit: str, figure: str) -> dict[str, float]:
        """A figure by scene."""
        return {s.scene: s.figures[figure] for s in self.scores if s.edit == edit}


def bounded(value: Interval, figure: str, sign: str = "") -> str:
    """A mean with its interval, if it has one, and the number of undefined scenes.

    Shares and fewer than :data:`FEWEST_SCENES` scenes have no interval.
    """
    if math.isnan(value.mean):
        return ""
    form = f"{{:{sign}.{3 if figure in WARP_FIGURES else 2}f}}".format
    sure = value.scenes >= FEWEST_SCENES and figure not in SHARES
    text = bracketed(value.mean, *((value.low, value.high) if sure else ()), form=form)
    return text + (f" ({value.undefined} undefined)" if value.undefined else "")


def table(scores: Sequence[Score]) -> Table:
    """The figures by edit: means over scenes, see :func:`bounded`."""
    edits: dict[str, list[Score]] = {}
    for score in scores:
        edits.setdefault(score.edit, []).append(score)
    rows = [["scenes", *(str(len(those)) for those in edits.values())]]
    for name, head in heads_of(scores[0].edit).items():
        over = (interval({s.scene: [s.figures[name]] for s in those}) for those in edits.values())
        rows.append([head, *(bounded(value, name) for value in over)])
    return Table(["figure", *edits], rows)


def compare(results: Sequence[Result]) -> Report:
    """Compare methods on one bench, by track and edit.

    The own editor's tables have every method of pictures; differences are paired by scene with the
    first one of the same editor, else with the first of all.

    Raises:
        InputError: results of two benches.
    """
    first = results[0]
    for result in results:
        if result.bench != first.bench:
            raise InputError(
                f"{result.method.name}: was scored on another bench than {first.method.name};"
                " score both on one"
            )
    tracks = {
        track: [r for r in results if r.method.track in ((SAME, OWN) if track == OWN else (track,))]
        for track in ORDER
    }
    sections = [
        Section(
            ": ".join(dict.fromkeys((track, edit))).capitalize(),
            ["Of shares of what is visible, more is better."] if track == WARPS else [],
            tables=[_compared(those, track, edit)],
        )
        for track, those in tracks.items()
        if any(result.method.track == track for result in those)
        for edit in dict.fromkeys(edit for result in those for edit in result.edits)
    ]
    places: dict[str, list[str]] = {}
    for r in results:
        who = ", ".join(filter(None, (r.method.name, r.method.editor)))
        for s in r.scores:
            for text in s.remarks:
                places.setdefault(f"- {who}: {text}", []).append(f"{s.scene} {s.edit}")
    remarks = [f"{text} ({', '.join(where)})" for text, where in places.items()]
    lead = [
        f"{_bench(first.bench)} Means over scenes; from six scenes on with their 95 % intervals."
        " The last column is the difference, paired by scene, from the first method with the same"
        " editor, else from the first of all. Less is better."
        + " Disagreement is read beside the change of the source."
        * bool(tracks[OWN])
    ]
    if remarks:
        sections.append(Section("Remarks", ["\n".join(remarks)]))
    return Report("Methods on a bench", lead, sections)


def _bench(of: Mapping[str, Any]) -> str:
    drawn = f"Drawn scenes of generator {of['generator']}, {len(of['views'])} views"
    asked = {"size": of["size"], "spp": of["spp"], "targets": len(of["views"]) - 1}
    options = " ".join(
        f"--{name} {value}" for name, value in (asked | {"seed": of["seed"]}).items()
    )
    return f"{drawn}: `attnwarp-eval bench export bench {options}`."


def _compared(results: Sequence[Result], track: str, edit: str) -> Table:
    figure = ORDER[track]
    heads = heads_of(edit)
    keys = [figure, *(key for key in heads if key != figure)]
    scenes = {scene for result in results for scene in result.values(edit, figure)}
    ranked = []
    for result in results:
        if edit not in result.edits:
            continue
        told, values = result.method, result.values(edit, figure)
        first = next((r for r in results if r.method.editor == told.editor), results[0])
        first = results[0] if first is result else first
        means = [bounded(_over(result.values(edit, key)), key) for key in keys]
        gain = paired(_by_scene(first.values(edit, figure)), _by_scene(values))
        seconds = "" if told.seconds is None else f"{told.seconds:.0f}"
        row = [told.name, told.editor, str(len(values)), *means, seconds]
        row.append("" if first is result else bounded(gain, figure, "+"))
        ranked.append((values.keys() < scenes, _over(values).mean, row))
    ranked.sort(key=lambda one: (one[0], math.isnan(one[1]), one[1]))
    columns = ["method", "editor", "scenes", *(heads[key] for key in keys), "seconds"]
    columns.append(f"{figure}, difference")
    shown = [k for k, column in enumerate(columns) if column != "editor" or track != WARPS]
    rows = [[row[k] for k in shown] for *_, row in ranked]
    return Table([columns[k] for k in shown], rows, timed=("seconds",))


def _over(values: Mapping[str, float]) -> Interval:
    return interval({scene: [value] for scene, value in values.items()})


def _by_scene(values: Mapping[str, float]) -> dict[str, dict[str, float]]:
    return {scene: {"": value} for scene, value in values.items()}
