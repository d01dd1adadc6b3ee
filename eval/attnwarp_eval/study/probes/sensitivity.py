"""Sensitivity of metrics: every metric on right results of an edit and on flawed ones.

A metric that ranks the right result above the flawed one sees that flaw. One that ranks them at
random is blind to it, and one that prefers the flaw moves the wrong way.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import Field, model_validator
from scipy import stats

from attnwarp.encoders import Kind, kind_of, load_encoder
from attnwarp.errors import InputError
from attnwarp_eval import metrics
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.cost import in_turn
from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Finding, Picture, Section, Table
from attnwarp_eval.document.numbers import number, spread
from attnwarp_eval.metrics import registry
from attnwarp_eval.metrics.arrays import Array
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.statistics.intervals import Interval, interval
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.flawed_edits import (
    CONDITIONS,
    RIGHT,
    STRENGTHS,
    Shot,
    Task,
    shots_of,
    tasks,
)
from attnwarp_eval.study.probes import register
from attnwarp_eval.study.probes.base import Layout, Place, Probe, Work, metrics_of
from attnwarp_eval.study.record import Json, Record
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Part, Study, StudyError, check_distinct, did_you_mean
from attnwarp_eval.two_view import TwoView

FIDELITY = (
    *(
        f"fidelity.{name}{place}"
        for place in ("", ".inside")
        for name in ("mse", "psnr", "ssim", "distance")
    ),
    *(f"fidelity.preserved_{name}" for name in ("mse", "psnr", "ssim", "distance")),
)
"""Figures of :func:`attnwarp_eval.metrics.fidelity` that a record has."""

CONSISTENCY = ("consistency.delta_e", "consistency.rmse_srgb", "consistency.pixels")
"""Figures of :func:`attnwarp_eval.metrics.cross_view` that a record has: of the edited object,
against the source view.
"""


STEPS = tuple(c.name for c in CONDITIONS[: len(STRENGTHS)])
"""Conditions of rising strength; the last is the right result."""

FLAWS = tuple(c for c in CONDITIONS if c.name != RIGHT)

_EDIT = (*STEPS[:-1], "wrong_colour", "wrong_object")
_ALL = tuple(c.name for c in FLAWS)


@dataclass(frozen=True)
class Row:
    """A metric as the figure shows it.

    Attributes:
        key: what ranks. A PSNR ranks by its MSE, which is finite where pictures are equal.
        title: for people.
        meant: flaws that it is there to see; its discriminating power is the mean over them.
        cost: whose seconds are its own.
    """

    key: str
    title: str
    meant: tuple[str, ...]
    cost: str


_CHANGED = ("wrong_object", "blurred", "noisy", "misplaced")

ROWS = (
    Row("embedding.clip_similarity", "CLIP, prompt", _EDIT, "embedding.clip_similarity"),
    Row("embedding.clip_directional", "CLIP, direction", _EDIT, "embedding.clip_directional"),
    Row(
        "embedding.clip_image",
        "CLIP, source edit",
        (*_EDIT, "inconsistent"),
        "embedding.clip_image",
    ),
    Row(
        "embedding.dino_image",
        "DINO, source edit",
        (*_EDIT, "inconsistent"),
        "embedding.dino_image",
    ),
    Row(
        "consistency.delta_e",
        "consistency, dE00",
        ("inconsistent", "noisy", "misplaced"),
        "consistency.delta_e",
    ),
    Row("fidelity.preserved_mse", "rest unchanged, PSNR", _CHANGED, "fidelity.mse"),
    Row("fidelity.preserved_ssim", "rest unchanged, SSIM", _CHANGED, "fidelity.ssim"),
    Row("fidelity.mse", "truth, PSNR", _ALL, "fidelity.mse"),
    Row("fidelity.ssim", "truth, SSIM", _ALL, "fidelity.ssim"),
    Row("fidelity.distance", "truth, perceptual", _ALL, "fidelity.distance"),
    Row("fidelity.mse.inside", "truth inside, PSNR", _ALL, "fidelity.mse"),
    Row("fidelity.ssim.inside", "truth inside, SSIM", _ALL, "fidelity.ssim"),
    Row("fidelity.distance.inside", "truth inside, perceptual", _ALL, "fidelity.distance"),
)
"""The metrics, those that need no truth first."""

Values = Mapping[str, float]
"""A view's figures by key; NaN where undefined."""


class StudyPart(Part):
    """Keys of a study that only this probe reads."""

    encoders: dict[Kind, str] = Field(
        default_factory=dict, description="by kind, as load_encoder takes them"
    )
    edits: list[str] = Field(
        default_factory=list, description="edits by name; all of a scene's if empty"
    )

    @model_validator(mode="after")
    def _check_encoders_and_edits(self) -> StudyPart:
        for kind, name in self.encoders.items():
            try:
                actual = kind_of(name)
            except InputError as error:
                raise ValueError(f"encoders.{kind}: {error}") from None
            if actual != kind:
                raise ValueError(f"encoders.{kind}: {name!r} is of kind {actual!r}")
        check_distinct(self.edits, "edits")
        return self


@dataclass(frozen=True)
class Seconds:
    """Seconds of one picture by metric and round, taken in turn."""

    seconds: Mapping[str, list[float]]

    def to_json(self) -> Json:
        """The entry ``rounds`` of the record's cost."""
        return {"cost": {"rounds": dict(self.seconds)}} if self.seconds else {}


Records = Sequence[tuple[str, Record[Seconds]]]
"""(scene, record) of a run's finished cells."""


@register
class Sensitivity(Probe[Seconds]):
    """One cell for all metrics of a scene: they judge the same pictures, and run in turn.

    A view of a record is named ``task/target``, a figure ``metric.condition``.
    """

    name = "sensitivity"
    study_part = StudyPart
    metrics = metrics_of("fidelity.", "consistency.", "embedding.")
    judges_variants = False
    draws = False
    study_keys = frozenset({"size", "views", "seeds", "spp", "timing_rounds", "encoders", "edits"})

    def check(self, study: Study) -> None:
        """Variants change no metric."""
        if study.probes.get(self.name):
            raise ValueError(
                "probes.sensitivity: got variants, expected []; it judges metrics, which no variant"
                " changes"
            )

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """One for each scene and seed."""
        part = study.part(StudyPart)
        identities = encoder_identities(part)
        available = dict.fromkeys(edit.name for scene in scenes.values() for edit in scene.edits)
        for edit in part.edits:
            if edit not in available:
                raise StudyError(
                    f"edits: no scene has an edit {edit!r}{did_you_mean(edit, available)}"
                )
        for name, scene in scenes.items():
            for seed in study.seeds:
                spec = {
                    **self.common_spec(study, scene, seed),
                    "spp": study.spp,
                    "rounds": study.timing_rounds,
                    "encoders": identities,
                    "tasks": [task.to_dict() for task in _tasks_of(scene, part.edits)],
                }
                sources = {str(kind): part.encoders[kind] for kind in sorted(part.encoders)}
                yield Cell(spec, name, "metrics", self.name, seed, ("metrics",), sources=sources)

    def compute(self, work: Work) -> Seconds:
        """Every metric on every condition of every task; metrics without an encoder are left
        out.
        """
        spec, world, meter = work.spec, work.world, work.meter
        with meter.stage("setup"):
            encoders = loaded(work.cell.sources, spec["encoders"])
        seconds: dict[str, list[float]] = {}
        for index, task in enumerate(map(Task.from_dict, spec["tasks"])):
            with meter.stage("truth"):
                shots = shots_of(world, task, spec)
                source_shot = shots[world.source.name]
                source = {c.name: c.picture(source_shot, spec["seed"]) for c in CONDITIONS}
            prompts = _Prompts(task, source[RIGHT], encoders)
            for name in spec["views"]:
                with meter.stage("truth"):
                    pair = world.pair(name, spec["size"])
                    shot = shots[name]
                    pictures = {c.name: c.picture(shot, spec["seed"]) for c in CONDITIONS}
                    view = _View(pair, shot, source_shot)
                with meter.stage("checks"):
                    measured: dict[str, float] = {}
                    for condition, picture in pictures.items():
                        if picture is not None:
                            values = view.figures(
                                source[condition], picture, encoders.get("perceptual")
                            )
                            measured |= {f"{key}.{condition}": v for key, v in values.items()}
                    measured |= prompts.figures(view.original, pictures)
                    keys = {key.rpartition(".")[0] for key in measured}
                    for condition, picture in pictures.items():
                        if picture is None:  # undefined, and counted as such
                            measured |= {f"{key}.{condition}": math.nan for key in keys}
                meter.count(pictures=len(pictures))
                if index == 0 and name == spec["views"][0]:
                    with meter.stage("rounds"):
                        seconds = _rounds(
                            view, prompts, source["noisy"], pictures["noisy"], encoders, spec
                        )
                work.add(f"{task.name}/{name}", measured)
        return Seconds(seconds)

    def read_extra(self, data: Json) -> Seconds:
        """Read from the record's cost."""
        rounds = data["cost"].get("rounds", {})
        return Seconds({key: [float(v) for v in values] for key, values in rounds.items()})

    def findings(self, results: Results) -> Iterator[Finding]:
        """Find what the metrics that need no truth see best, and what they miss most, of the flaws
        that each is meant to see.
        """
        records = [(cell.scene, record) for cell, record in results.finished(self.name)]
        seen = [
            (value, row, flaw)
            for row in ROWS
            for flaw in FLAWS
            if row.meant != _ALL and flaw.name in row.meant
            if math.isfinite((value := share(records, row.key, flaw.name)).mean)
        ]
        if not seen:
            return
        about = "right results ranked above those with the flaw; 0.5 is blind"
        best, worst = (pick(seen, key=lambda item: item[0].mean) for pick in (max, min))
        for (value, row, flaw), text in ((best, "the most"), (worst, "the least")):
            yield Finding(
                f"Of what metrics without a truth are meant to see, {row.title} sees"
                f" {flaw.title!r} {text} often.",
                f"{spread(replace(value, undefined=0))} share",
                about,
                "holds" if value.mean > 0.5 else "fails",
            )

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """Sections on what each metric sees, how it follows the strength of an edit, and what it
        costs.
        """
        records = [(cell.scene, record) for cell, record in results.finished(self.name)]
        if not records:
            return
        rows = [
            row for row in ROWS if any(_has(values, row.key) for _, _, values in _views(records))
        ]
        shares = {row.key: {c.name: share(records, row.key, c.name) for c in FLAWS} for row in rows}
        yield Place.INSTRUMENT, _flaws(results, records, rows, shares, layout)
        yield Place.INSTRUMENT, _strengths(records, rows, layout)
        if layout.timings:
            yield Place.INSTRUMENT, _costs(records, rows, shares, layout)


def encoder_identities(part: StudyPart) -> dict[str, dict[str, Any]]:
    """Encoders by their weights: other weights give other cells, another folder does not."""
    identities = {}
    for kind, name in part.encoders.items():
        try:
            identities[kind] = identity(name, kind)
        except InputError as error:
            raise StudyError(f"encoders.{kind}: {error}") from None
    return {str(kind): identities[kind] for kind in sorted(identities)}


def _tasks_of(scene: Scene, edits: Sequence[str]) -> list[Task]:
    available = [edit.name for edit in scene.edits]
    if not available:
        raise StudyError(
            f"probes.sensitivity: scene {scene.name!r} names no edits, so there is no right"
            " result; leave it out, or give it some (docs/truth/scenes.md)"
        )
    selected = tasks(scene, edits)
    if not selected:
        raise StudyError(
            f"edits: scene {scene.name!r} has none of {', '.join(edits)}; there are"
            f" {', '.join(available)}"
        )
    return selected


def _views(records: Records) -> Iterator[tuple[str, str, Values]]:
    """(scene, task/view, figures)."""
    for scene, record in records:
        for view in record.views:
            yield scene, view.name, view.metrics


def identity(name: str, kind: Kind) -> dict[str, Any]:
    """Parts of an encoder that decide its figures: its weights and its preprocessing, not its path.

    Raises:
        InputError: see :func:`attnwarp.encoders.load_encoder`.
    """
    return identity_of(load_encoder(name, kind))


def identity_of(encoder: Any) -> dict[str, Any]:
    """:func:`identity` of an encoder that is loaded."""
    about = encoder.about.to_dict()
    return {key: about[key] for key in ("kind", "weights_sha256", "preprocessing", "size", "dim")}


def loaded(names: Mapping[str, str], expected: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Encoders by kind.

    Args:
        names: by kind, as :func:`attnwarp.encoders.load_encoder` takes them.
        expected: by kind, the :func:`identity` that they had when the run was planned.

    Raises:
        InputError: one cannot be loaded, or is another one by now.
    """
    encoders = {}
    for kind, planned in expected.items():
        encoders[kind] = load_encoder(names[kind])
        if identity_of(encoders[kind]) != planned:
            raise InputError(
                f"encoder {names[kind]!r}: its weights have changed since the run was planned;"
                " start the run again"
            )
    return encoders


class _View:
    """A view with what metrics need to judge a picture of it."""

    def __init__(self, pair: TwoView, shot: Shot, source: Shot) -> None:
        self.pair = pair
        self.mask = shot.mask
        self.original, self.truth = to_srgb(shot.before), to_srgb(shot.after)
        # What rightly differs between two views, before the edit or after it: highlights and
        # reflections.
        self.exclude = metrics.view_dependent(to_srgb(source.before), self.original, pair)
        self.exclude |= metrics.view_dependent(to_srgb(source.after), self.truth, pair)

    def figures(self, source: Array | None, picture: Array, perceptual: Any) -> dict[str, float]:
        """Fidelity and consistency of a picture."""
        distance = None if perceptual is None else _distance(perceptual)
        against = metrics.fidelity(
            picture, self.truth, self.mask, original_srgb=self.original, distance=distance
        )
        between = self.consistency(source, picture)
        return {
            **{key: against[key] for key in FIDELITY if key in against},
            **{key: between[key] for key in CONSISTENCY},
        }

    def consistency(self, source: Array | None, picture: Array) -> dict[str, float]:
        """Consistency of the edited object in the picture and in the source view of the same
        result.
        """
        return metrics.cross_view(
            source, picture, self.pair, mask=self.mask, exclude=self.exclude
        ).figures()


def _distance(perceptual: Any) -> Callable[[Array, Array], float]:
    return lambda a, b: float(perceptual.distance([a], [b])[0])


class _Prompts:
    """Embeddings of a task's prompts and of its edited source view, computed once."""

    def __init__(self, task: Task, source_edit: Array | None, encoders: Mapping[str, Any]) -> None:
        self.clip, self.dino = encoders.get("clip"), encoders.get("dino")
        if self.clip is not None:
            self.before, self.after = self.clip.texts([task.source, task.target])
            self.clip_source = self.clip.images([source_edit])
        if self.dino is not None:
            self.dino_source = self.dino.images([source_edit])

    def figures(self, original: Array, pictures: Mapping[str, Array | None]) -> dict[str, float]:
        """``embedding.*.condition`` of all conditions that have a picture."""
        available = {
            condition: picture for condition, picture in pictures.items() if picture is not None
        }
        similarities: dict[str, Array] = {}
        if self.clip is not None:
            *images, unedited = self.clip.images([*available.values(), original])
            images = np.stack(images)
            similarities["clip_similarity"] = metrics.clip_similarity(images, self.after).values
            befores = np.broadcast_to(unedited, images.shape)
            similarities["clip_directional"] = metrics.directional_similarity(
                befores, images, self.before, self.after
            ).values
            similarities["clip_image"] = metrics.image_similarity(self.clip_source, images).values
        if self.dino is not None:
            similarities["dino_image"] = metrics.image_similarity(
                self.dino_source, self.dino.images(list(available.values()))
            ).values
        return {
            f"embedding.{name}.{condition}": float(value)
            for name, values in similarities.items()
            for condition, value in zip(available, values, strict=True)
        }


def _rounds(
    view: _View,
    prompts: _Prompts,
    source: Array | None,
    picture: Array | None,
    encoders: Mapping[str, Any],
    spec: Mapping[str, Any],
) -> dict[str, list[float]]:
    """Seconds that one picture costs each metric, in turn in an order drawn anew each round; a
    first round does not count.

    What is made once for all pictures is in none of them: truth, correspondences, and the
    embeddings of the prompts, of the edited source view and of the view before the edit.
    """
    contestants: dict[str, Callable[[], Any]] = {
        "fidelity.mse": lambda: metrics.mse(picture, view.truth),
        "fidelity.ssim": lambda: metrics.ssim(picture, view.truth),
        "consistency.delta_e": lambda: view.consistency(source, picture),  # type: ignore[arg-type]
    }
    if (perceptual := encoders.get("perceptual")) is not None:
        contestants["fidelity.distance"] = lambda: perceptual.distance([picture], [view.truth])
    if (clip := prompts.clip) is not None:
        before = clip.images([view.original])
        contestants["embedding.clip_similarity"] = lambda: metrics.clip_similarity(
            clip.images([picture]), prompts.after
        )
        contestants["embedding.clip_directional"] = lambda: metrics.directional_similarity(
            before, clip.images([picture]), prompts.before, prompts.after
        )
        contestants["embedding.clip_image"] = lambda: metrics.image_similarity(
            prompts.clip_source, clip.images([picture])
        )
    if (dino := prompts.dino) is not None:
        contestants["embedding.dino_image"] = lambda: metrics.image_similarity(
            prompts.dino_source, dino.images([picture])
        )
    works = [lambda _, work=work: work() for work in contestants.values()]
    turns = in_turn(works, spec["rounds"], seed=spec["seed"])
    return dict(zip(contestants, turns.seconds, strict=True))


def _has(values: Values, key: str) -> bool:
    return f"{key}.{RIGHT}" in values


def _value(values: Values, key: str, condition: str) -> float:
    return float(values.get(f"{key}.{condition}", math.nan))


def beats(key: str, right: float, flawed: float) -> float:
    """1 where a metric ranks the right result above the flawed one, 0 below, 0.5 where it cannot
    tell them apart.

    Values that differ by no more than two runs of the metric may (its ``atol`` and ``rtol``) are
    told apart by nothing but the machine. NaN where either is undefined.
    """
    if not (math.isfinite(right) and math.isfinite(flawed)):
        return math.nan
    specification = registry.metric(key)
    gain = flawed - right if specification.direction == "lower" else right - flawed
    if abs(gain) <= specification.atol + specification.rtol * max(abs(right), abs(flawed)):
        return 0.5
    return float(gain > 0)


def share(records: Records, key: str, condition: str) -> Interval:
    """Share of the edits and views in which a metric ranks the right result above one with a flaw;
    ties are half.

    A mean over scenes with its interval. 1: it sees the flaw every time; 0.5: blind; below: it
    prefers the flaw.
    """
    table: dict[str, list[float]] = {}
    for scene, _, values in _views(records):
        won = beats(key, _value(values, key, RIGHT), _value(values, key, condition))
        table.setdefault(scene, []).append(won)
    return interval(table)


def curve(values: Values, key: str) -> tuple[float, float]:
    """Course of a metric with the strength of an edit in one view.

    Returns:
        Spearman's rank correlation of strength and metric, signed so that 1 is the right way, 0 for
        a metric that does not change; and 1 or 0: whether each step up in strength moves it the
        right way by more than its tolerance. NaN with fewer than three strengths that are defined.
    """
    pairs = [(s, _value(values, key, name)) for s, name in zip(STRENGTHS, STEPS, strict=True)]
    pairs = [(s, v) for s, v in pairs if math.isfinite(v)]
    if len(pairs) < 3:
        return math.nan, math.nan
    strengths, measured = np.array(pairs).T
    sign = -1 if registry.metric(key).direction == "lower" else 1
    rises = [beats(key, high, low) == 1 for low, high in itertools.pairwise(measured)]
    if np.ptp(measured) == 0:
        return 0.0, 0.0
    return sign * float(stats.spearmanr(strengths, measured).statistic), float(all(rises))


def power(row: Row, shares: Mapping[str, Interval]) -> float:
    """Mean share over the flaws that a metric is meant for; NaN where none is defined."""
    means = [shares[name].mean for name in row.meant if math.isfinite(shares[name].mean)]
    return float(np.mean(means)) if means else math.nan


def _flaws(
    results: Results,
    records: Records,
    rows: list[Row],
    shares: Mapping[str, Mapping[str, Interval]],
    layout: Layout,
) -> Section:
    spec = records[0][1].spec
    views = {(scene, name) for scene, name, _ in _views(records)}
    edits = {(scene, name.rpartition("/")[0]) for scene, name in views}
    count = _scene_count(records)
    text = [
        (
            f"{len(edits)} right results of edits in {count} scenes, {len(views)} pairs of a"
            " result and a view. Each is compared with results that a method may have given in its"
            " place, each with one flaw. The figure: the share in which a metric ranks the right"
            " result above the flawed one. **1: it sees the flaw. 0.5: blind to it. Below 0.5: it"
            " prefers the flaw.** Differences within a metric's tolerance count as half."
        ),
        (
            "Framed: what a metric is meant to see. Metrics against the truth compare with the"
            " right result itself and lose only where nothing of a view shows the flaw; of the"
            " others, which a person has without a truth, a figure is news. Wrong colours, weak"
            " edits and blur are alike in all views, the source included: a metric of consistency"
            " should be blind to them."
        ),
        encoders_named(results, spec),
    ]
    if count < len(results.study.scenes):
        text.insert(0, f"**Measured on {count} of {len(results.study.scenes)} scenes.**")
    means = np.array([[shares[row.key][c.name].mean for c in FLAWS] for row in rows])
    framed = np.array([[c.name in row.meant for c in FLAWS] for row in rows])
    path = layout.figure("sensitivity.svg")
    with charts.drawing(path, height=0.8 + 0.34 * len(rows), width=9.6) as (axes,):
        charts.heatmap(
            axes,
            means,
            rows=[row.title for row in rows],
            columns=[c.title for c in FLAWS],
            framed=framed,
            title="share in which the right result is ranked above the flawed one",
        )
    drawn = Picture(
        "figures/sensitivity.svg",
        "Which metric can see what: 1 sees the flaw, 0.5 is blind, below 0.5 prefers it.",
    )
    table = [[row.title, *(spread(shares[row.key][c.name], count) for c in FLAWS)] for row in rows]
    columns = ["metric", *(c.title for c in FLAWS)]
    return Section(
        "Which metric can see what",
        text,
        [Table(columns, table, "Shares with intervals", folded=True)],
        [drawn],
    )


def encoders_named(results: Results, spec: Mapping[str, Any]) -> str:
    """A sentence with the encoders of a cell and the first digits of their weights' SHA-256."""
    names = results.study.part(StudyPart).encoders
    encoders = [
        f"{kind} `{names[kind]}` ({identity['weights_sha256'][:12]})"
        for kind, identity in spec["encoders"].items()
    ]
    return f"Encoders: {', '.join(encoders) or 'none, so what needs one is left out'}."


def _strengths(records: Records, rows: list[Row], layout: Layout) -> Section:
    count, table, drawn = _scene_count(records), [], []
    for row in rows:
        by_scene: dict[str, list[tuple[float, float]]] = {}
        for scene, _, values in _views(records):
            by_scene.setdefault(scene, []).append(curve(values, row.key))
        rank, steps = (
            interval({s: [pair[i] for pair in v] for s, v in by_scene.items()}) for i in (0, 1)
        )
        table.append([row.title, spread(rank, count), spread(steps, count)])
        if ".inside" not in row.key:
            drawn.append((row, [_mean(records, row.key, name) for name in STEPS]))
    columns = 3
    path = layout.figure("sensitivity-strength.svg")
    lines = -(-len(drawn) // columns)
    with charts.drawing(path, columns, 1.9 * lines, rows=lines, width=3.0 * columns) as axes:
        for panel, (row, means) in zip(axes, drawn, strict=False):
            unit = registry.metric(row.key).unit
            line = charts.Line(row.title, STRENGTHS, means)
            better = (
                "less is better"
                if registry.metric(row.key).direction == "lower"
                else "more is better"
            )
            label = row.title.replace("PSNR", "MSE")
            charts.lines(
                panel, [line], x="strength", y=unit, title=f"{label} ({better})", legend=False
            )
        for panel in axes[len(drawn) :]:
            panel.axis("off")
    text = [
        (
            "The right result at part of its strength, blended with the view before the edit in"
            " linear light. Rank correlation: Spearman's, between strength and metric, 1 when every"
            " step moves it the right way, 0 for none. The share beside it: edits and views in"
            " which each of the four steps is seen, beyond the metric's tolerance. At strength 0"
            " nothing has changed, and a direction of change is undefined."
        ),
    ]
    headings = ["metric", "rank correlation with strength", "share with every step seen"]
    caption = "Means over scenes against the strength of the edit, with 95 % intervals over scenes."
    picture = Picture("figures/sensitivity-strength.svg", caption)
    return Section(
        "Metrics against the strength of an edit", text, [Table(headings, table)], [picture]
    )


def _scene_count(records: Records) -> int:
    """A scene has a record for each seed."""
    return len({scene for scene, _ in records})


def _mean(records: Records, key: str, condition: str) -> Interval:
    table: dict[str, list[float]] = {}
    for scene, _, values in _views(records):
        table.setdefault(scene, []).append(_value(values, key, condition))
    return interval(table)


def _costs(
    records: Records,
    rows: list[Row],
    shares: Mapping[str, Mapping[str, Interval]],
    layout: Layout,
) -> Section:
    spec = records[0][1].spec
    points: dict[str, tuple[Interval, Interval]] = {}
    powers = {}
    for row in rows:
        taken: dict[str, list[float]] = {}
        for scene, record in records:  # one for each seed
            if rounds := record.extra.seconds.get(row.cost):
                taken.setdefault(scene, []).append(float(np.median(rounds)))
        if not taken:
            continue
        seconds = interval(taken)
        powers[row.title] = power(row, shares[row.key])
        missed = _point(1 - powers[row.title])
        points[row.title] = (seconds, missed)
    path = layout.figure("sensitivity-cost.svg")
    # The truth is what a metric is judged by here; those that know it are on a front of their own.
    apart = [
        (
            "without the truth",
            {
                row.title: points[row.title]
                for row in rows
                if row.title in points and row.meant != _ALL
            },
        ),
        (
            "against the truth",
            {
                row.title: points[row.title]
                for row in rows
                if row.title in points and row.meant == _ALL
            },
        ),
    ]
    on_front: list[str] = []
    with charts.drawing(path, columns=2, height=4.2, width=11.5) as axes:
        for panel, (title, some) in zip(axes, apart, strict=True):
            on_front += charts.cost_front(
                panel,
                some,
                x="seconds a picture",
                y="missed: 1 - discriminating power",
                title=title,
                log=False,
            )
    table = [
        [
            row.title,
            number(1000 * points[row.title][0].mean),
            number(powers[row.title]),
            "yes" if row.title in on_front else "no",
            (
                ", ".join(c.title for c in FLAWS if c.name in row.meant)
                if row.meant != _ALL
                else "all"
            ),
        ]
        for row in rows
        if row.title in points
    ]
    text = [
        (
            f"Milliseconds of one {spec['size']} x {spec['size']} px picture: median of"
            f" {spec['rounds']} rounds in which all metrics took turns in one process, on one"
            " thread, in an order drawn anew; mean over scenes. What is made once for all pictures"
            " is in none of them: truth, correspondences, the embeddings of the prompts, of the"
            " edited source view and of the view before the edit. Discriminating power: the mean"
            " share over the flaws that a metric is meant for. A metric is on the front when"
            " nothing cheaper of its kind sees as much."
        ),
    ]
    columns = ["metric", "ms a picture", "discriminating power", "on the front", "meant for"]
    drawn = Picture("figures/sensitivity-cost.svg", "What a metric misses against what it costs.")
    return Section(
        "What a metric costs and what it can see", text, [Table(columns, table)], [drawn]
    )


def _point(value: float) -> Interval:
    return Interval(value, math.nan, math.nan, 1, 1, 0, math.nan, math.nan)
