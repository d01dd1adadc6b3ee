"""A scene edited by a method, against the true pictures of the edit.

Views of a record are named ``edit/view``. Figures end in ``.edit`` for the edited views and in
``.render`` for renders of the edited splats. Where the editor did not do the edit in the source
view, figures of agreement between views are undefined: there was nothing to carry.
"""

from __future__ import annotations

import hashlib
import json
import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt
import torch
from pydantic import Field

from attnwarp import Camera, Gaussians, check
from attnwarp.errors import InputError
from attnwarp.fit import compile_kernels
from attnwarp.warp import PRESETS, WarpedView, WarpSettings, warp_view
from attnwarp_eval import metrics
from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.cost import Meter
from attnwarp_eval.document.model import Section
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.splats.fitted import surface_error
from attnwarp_eval.study import pictures
from attnwarp_eval.study.budgets import BudgetPart, Spent, Stopwatch, timed
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.edit_truth import (
    EditTruth,
    Judgement,
    answers_of,
    neighbours,
    planned_truth,
)
from attnwarp_eval.study.editing_methods import (
    EDITING_METHODS,
    EditedScene,
    Job,
    with_source_words,
)
from attnwarp_eval.study.hand_made import Kind, hand_made
from attnwarp_eval.study.probes import editing_sections, register, sensitivity
from attnwarp_eval.study.probes.base import Layout, Place, Probe, Work, metrics_of
from attnwarp_eval.study.probes.variant_splats import (
    splats_meaning,
    splats_of,
    splats_reads,
    splats_spec,
)
from attnwarp_eval.study.reads import MASK_RULES
from attnwarp_eval.study.record import Json, Record, with_nan
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Part, Study, StudyError, Variant, did_you_mean
from attnwarp_eval.study.warping import warp_truth

if TYPE_CHECKING:
    from attnwarp.editing.controlnet import DepthControlNet
    from attnwarp.editing.pix2pix import InstructPix2Pix
    from attnwarp.methods import Budget
    from attnwarp_eval.two_view import Hits

Image = npt.NDArray[np.float32]

EDITING_PARTS = ("source", "warp", "edit")
"""Parts of a method's seconds that are neither tuning nor for people."""

OWN_WORK = (*EDITING_PARTS, "tune")
"""Parts of a method's seconds that are its own; renders and files are for people."""

FIDELITY = ("psnr", "mse", "ssim")
"""Figures of :func:`attnwarp_eval.metrics.fidelity` that a record has, of the whole picture and
inside the edited object."""


LEAST_PIXELS = 16
"""Agreement is undefined where fewer pixels of a view are compared, the area of one cell of the
bundled editors' latents. Views count alike in a mean, so a single pixel would weigh as much as a
whole view."""

STOPWATCH = Stopwatch()
"""Seconds of the methods that this process has run."""

EDITS = frozenset({"editing", "editing-timing", "variability"})
"""Probes of methods that edit."""

CHOSEN_BY = ("multiview.delta_e_above.edit_inside", "fidelity.mse.edit_inside")
"""Figures that choose the variant for a given time; less is better."""


class EditorPart(Part):
    """An editor of single views.

    ``name`` is bundled or a folder in diffusers' format. Guidance left out is the editor's own.
    """

    name: str = "small-plain"
    text_guidance: float | None = Field(default=None, ge=0)
    image_guidance: float | None = Field(default=None, ge=0)


class Editing(Part):
    """Settings that all variants share.

    ``edits``: by scene, an edit's name, or ``edit=answer`` for one of its answers alone, with the
    words that the editor is given; the edit's own words where they are null. Scenes that are left
    out have all their edits. ``by_yaw``: variants whose figures the report shows by yaw.
    """

    editor: EditorPart = EditorPart()
    edits: dict[str, dict[str, str | None]] = Field(default_factory=dict)
    options: dict[str, Any] = Field(
        default_factory=dict, description="fields of attnwarp.methods.AttentionWarpingSettings"
    )
    by_yaw: list[str] = Field(default_factory=list)
    choice: list[str] = Field(
        default_factory=list, description="variants, one of which is chosen for a given time"
    )


class StudyPart(Part):
    """Keys of a study that only this probe reads; ``encoders`` belong to the probe sensitivity."""

    editing: Editing = Editing()


class VariantPart(Part):
    """Keys of a variant that only this probe reads.

    ``options`` are fields of the method's settings, over the study's; ``preset`` among them goes
    before the variant's. ``{source}`` in ``source_prompt`` stands for the edit's
    ``source`` words. ``mask: truth`` injects where the source truly sees the
    surface, ``geometry: truth`` warps by exact depth. ``budget`` cuts the method short.
    ``by_hand`` gives the method a source view that was edited by hand
    (:mod:`attnwarp_eval.study.hand_made`) instead of letting the editor edit it.
    """

    method: str = "attention_warping"
    options: dict[str, Any] = Field(default_factory=dict)
    mask: Literal["rules", "truth"] = "rules"
    editor: EditorPart | None = None
    budget: BudgetPart | None = None
    by_hand: Kind | None = None


@dataclass(frozen=True)
class EditResult:
    """Entries of a cell's record beside the figures of its views.

    Attributes:
        name, instruction: of the edit.
        source: what the source's edit shows.
        alone: what all edited views together show, the source's included.
        answers: by "edit" and "render": by view, the nearest answer; None where nothing of the
            object shows.
        overall: by "edit" and "render", the answer nearest to all views together.
        edit_psnr: dB, edited views against renders, pooled, where a surface shows.
        edited: number of edited views.
        injected: mean share of the targets' pixels that got features; 0 without a warp.
        budget: of the method; None for none.
    """

    name: str
    instruction: str
    source: Judgement
    alone: Judgement
    answers: Mapping[str, Mapping[str, str | None]]
    overall: Mapping[str, str | None]
    edit_psnr: float
    edited: int
    injected: float
    budget: Spent | None = None

    def to_json(self) -> Json:
        """The record's entry ``edit``."""
        data = dict(without_nan(asdict(self)))
        if self.budget is None:
            del data["budget"]
        return {"edit": data}

    @classmethod
    def from_json(cls, data: Json) -> EditResult:
        """Rebuild from :meth:`to_json`."""
        judgements = {
            key: Judgement(
                data[key]["answer"],
                data[key]["done"],
                **with_nan({k: data[key][k] for k in ("psnr", "unedited", "unchanged")}),
            )
            for key in ("source", "alone")
        }
        own = with_nan({"edit_psnr": data["edit_psnr"]})
        budget = {"budget": Spent(**data["budget"])} if data.get("budget") else {}
        return cls(**{**data, **judgements, **own, **budget})


@register
class EditingProbe(Probe[EditResult]):
    """One edit of one scene by one method."""

    name = "editing"
    protocol = 2
    study_part = StudyPart
    variant_part = VariantPart
    metrics = metrics_of("multiview.", "fidelity.", "embedding.", "depth.", "image.")
    tabulates_all = True
    columns: ClassVar[Mapping[str, str]] = {
        "same answer": "multiview.same_answer.edit",
        "... where the source saw it": "multiview.same_answer.edit_seen",
        "disagreement above floor, dE00": "multiview.delta_e_above.edit_inside",
        "... of neighbours": "multiview.delta_e_above.edit_next",
        "... in renders": "multiview.delta_e_above.render_inside",
        "PSNR to truth inside, dB": "fidelity.psnr.edit_inside",
        "... inside, pooled": "fidelity.mse.edit_inside",
        "PSNR of renders, dB": "fidelity.psnr.render_inside",
        "... of renders, pooled": "fidelity.mse.render_inside",
        "Edit PSNR, dB": "image.psnr.edit_render",
        "Edit PSNR, pooled": "image.mse.edit_render",
        "CLIP direction": "embedding.clip_directional.render",
        "CLIP image": "embedding.clip_image.render",
        "DINO image": "embedding.dino_image.render",
        "AbsRel of depth after": "depth.abs_rel.after",
    }
    contrasts = (
        "multiview.same_answer.edit",
        "multiview.delta_e_above.edit_inside",
        "multiview.delta_e_above.render_inside",
        "fidelity.psnr.edit_inside",
        "fidelity.psnr.render_inside",
        "embedding.clip_directional.render",
        "depth.abs_rel.after",
    )
    stage = "whole"
    cost = "whole"
    cost_of = "an edit"
    edits = True
    study_keys = frozenset({"size", "views", "seeds", "spp", "editing", "encoders"})
    shared: ClassVar[Mapping[tuple[str, ...], str]] = {
        ("editing", "options"): "options",
        ("editing", "editor"): "editor",
    }
    cost_text = (
        "Seconds are those of one whole edit of a scene: source, warps, edited views and tuning."
    )

    # From a study to cells

    def check(self, study: Study) -> None:
        """Figures by yaw need their variants measured."""
        part = study.part(StudyPart).editing
        study.check_variants(part.by_yaw, "editing.by_yaw", self.name)
        study.check_variants(part.choice, "editing.choice", self.name)
        for name, variant in study.variants.items():
            budget = variant.part(VariantPart).budget
            if budget is None or budget.seconds_of is None:
                continue
            key = f"variants.{name}.budget.seconds_of"
            study.check_variants([budget.seconds_of], key)
            other = study.variants[budget.seconds_of].part(VariantPart).budget
            if other is not None and other.seconds_of is not None:
                raise ValueError(
                    f"{key}: {budget.seconds_of!r} has seconds_of itself; name a variant that has"
                    " none"
                )

    def check_scenes(self, study: Study, scenes: Sequence[Scene]) -> None:
        """A scene without an entry has all of its edits measured, so a misspelt one matters."""
        names = [scene.name for scene in scenes]
        for name in study.part(StudyPart).editing.edits:
            if name not in names:
                raise StudyError(
                    f"editing.edits: the study has no scene {name!r}{did_you_mean(name, names)}"
                )

    def check_variant(self, study: Study, variant: Variant) -> None:
        """Settings are refused even where nothing is edited."""
        own = variant.part(VariantPart)
        check.one_of(own.method, list(EDITING_METHODS), "method")
        if own.budget is not None and not EDITING_METHODS[own.method].takes_budget:
            able = ", ".join(
                repr(name) for name, method in EDITING_METHODS.items() if method.takes_budget
            )
            raise ValueError(
                f"budget: method {own.method!r} runs to its end; methods with a budget are {able}"
            )
        if own.by_hand is not None and not EDITING_METHODS[own.method].takes_picture:
            able = ", ".join(
                repr(name) for name, method in EDITING_METHODS.items() if method.takes_picture
            )
            raise ValueError(
                f"by_hand: method {own.method!r} edits its source itself; methods that take a"
                f" picture are {able}"
            )
        if own.options or not EDITS.isdisjoint(study.probes):
            settings_of(study, variant, 0)

    def measured(self, study: Study) -> Set[str]:
        """Variants whose seconds limit others are run too."""
        names = study.variants.keys() & super().measured(study)
        references = {_reference(study.variants[name]) for name in names}
        return names | {name for name in references if name is not None}

    def reads(self, study: Study, variant: Variant) -> Set[str]:
        """Keys that the method reads, and those of its editor and its splats."""
        own = variant.part(VariantPart)
        settings = settings_of(study, variant, 0)
        read = {"method", "budget", "by_hand", *splats_reads(variant)}
        read |= EDITING_METHODS[own.method].reads(settings)
        one_mask = settings.get("sources", 1) == 1 and not settings.get("confidence")
        if own.mask == "truth" and one_mask:
            read -= MASK_RULES
        if "preset" in own.options:
            read -= {"preset"}
        if "editor" in read:
            guidance = ("text_guidance", "image_guidance")
            read -= {"editor"}
            read |= {"editor.name"}
            read |= {f"editor.{name}" for name in guidance if settings.get(name) is None}
        return read

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """One for each scene, edit, variant and seed."""
        wanted = study.part(sensitivity.StudyPart)
        encoders = sensitivity.encoder_identities(wanted)
        sources = {str(kind): name for kind, name in wanted.encoders.items()}
        for name, scene in scenes.items():
            edits = list(edits_of(study, scene))
            for label in names:
                variant = study.variants[label]
                names_of = {"editor": editor_of(study, variant).name}
                reference = _reference(variant)
                if reference is not None:
                    names_of["reference"] = reference
                    other = study.variants[reference]
                    names_of["reference editor"] = editor_of(study, other).name
                for seed in study.seeds:
                    decided = {
                        **self.common_spec(study, scene, seed),
                        **self.variant_spec(study, variant, seed),
                    }
                    views = study.pictures_of(decided["views"], label)
                    for edit in edits:
                        yield Cell(
                            {**decided, "edit": edit, "encoders": encoders},
                            name, label, self.name, seed, (label,),
                            tuple(f"{edit['name']}/{view}" for view in views),
                            {**sources, **names_of},
                        )  # fmt: skip

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """The method with all its settings, the editor, and where splats and warps come from."""
        own = variant.part(VariantPart)
        settings = settings_of(study, variant, seed)
        return {
            "spp": study.spp,
            "method": own.method,
            "settings": settings,
            "editor": editor_identity(editor_of(study, variant)),
            "geometry": variant.geometry,
            "mask": own.mask,
            **splats_spec(study, variant, seed),
            **self._budget_spec(study, variant, seed),
            **({"by_hand": own.by_hand} if own.by_hand is not None else {}),
        }

    def _budget_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """Limits of the method; for the seconds of another variant, all that decides its run."""
        part = variant.part(VariantPart).budget
        if part is None:
            return {}
        budget = part.model_dump(exclude_none=True)
        reference = _reference(variant)
        if reference is not None:
            other = study.variants[reference]
            budget["seconds_of"] = self.variant_spec(study, other, seed)
        return {"budget": budget}

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        """Everything that decides a cell but for its seed."""
        own = variant.part(VariantPart)
        settings = settings_of(study, variant, 0)
        return (
            own.method, settings, variant.geometry, own.mask, splats_meaning(study, variant),
            editor_of(study, variant), own.budget, own.by_hand,
        )  # fmt: skip

    def alike(self, study: Study, variant: Variant, wanted: Variant) -> bool:
        """Return True if method, editor, splats, warp and budget are the same. Of the method's
        other settings, only those count that ``wanted`` names.
        """
        if variant.part(VariantPart).method != wanted.part(VariantPart).method:
            return False  # the study's options need not fit the other method
        counts = {"warp", *wanted.part(VariantPart).options}

        def kind(of: Variant) -> list[Any]:
            return [
                {k: v for k, v in part.items() if k in counts} if isinstance(part, dict) else part
                for part in self.meaning(study, of)
            ]

        return kind(variant) == kind(wanted)

    # From a cell to its record

    def compute(self, work: Work) -> EditResult:
        """Edit the scene, then measure every target."""
        spec, world, meter = work.spec, work.world, work.meter
        names = [world.source.name, *spec["views"]]
        with meter.stage("truth"):
            truth = planned_truth(work.cell, names)
        with meter.stage("splats"):
            before = splats_of(work)
        with meter.stage("setup"):
            encoders = sensitivity.loaded(work.cell.sources, spec["encoders"])
            _compile(before.kind)
        budget = self._budget(work, truth, names)
        result = run_method(work, truth, names, before, budget)
        STOPWATCH.note(_decisive(spec), _own_seconds(result))
        for part, seconds in result.seconds.items():
            meter.add(f"method: {part}", seconds)
        meter.add("whole", _own_seconds(result))
        meter.count(**{k: int(v) for k, v in result.counters.items() if k != "injected"})
        with meter.stage("checks"):
            extra = _Measure(work, truth, names, before, result, encoders).record()
        if budget is None:
            return extra
        given = work.cell.sources.get("reference")
        return replace(extra, budget=Spent(budget.seconds, given, budget.network_rows, result.cut))

    def _budget(self, work: Work, truth: EditTruth, names: Sequence[str]) -> Budget | None:
        """Limits of the work's method; a variant whose seconds are the limit is run if need be."""
        from attnwarp.methods import Budget

        given = work.spec.get("budget")
        if given is None:
            return None
        seconds = given.get("seconds")
        if "seconds_of" in given:
            shared = {k: work.spec[k] for k in _SHARED if k in work.spec}
            sources = {**work.cell.sources, "editor": work.cell.sources["reference editor"]}
            cell = replace(work.cell, spec={**shared, **given["seconds_of"]}, sources=sources)
            other = Work(cell, work.root, work.scene_world, Meter())

            def run() -> float:
                limits = self._budget(other, truth, names)
                return _own_seconds(run_method(other, truth, names, splats_of(other), limits))

            with work.meter.stage("budget"):
                seconds = STOPWATCH.seconds(_decisive(cell.spec), run)
        return Budget(seconds, given.get("network_rows"))

    def read_extra(self, data: Json) -> EditResult:
        """Read from the record's entry ``edit``."""
        return EditResult.from_json(data["edit"])

    def repeatable(self, record: Record[EditResult]) -> bool:
        """False when a time budget limited the method."""
        return not timed(record.spec)

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """Sections on the editor's abilities, budgets, figures by yaw, time by part."""
        if not results.finished(self.name):
            return
        abilities = editing_sections.abilities(results, self.name)
        spec = results.finished(self.name)[0][1].spec
        if "encoders" in spec:
            abilities.text.append(sensitivity.encoders_named(results, spec))
        yield Place.INSTRUMENT, abilities
        part = results.study.part(StudyPart).editing
        if (section := editing_sections.budgets(results, self.name)) is not None:
            yield Place.RESULT, section
        if part.by_yaw:
            yield Place.RESULT, editing_sections.by_yaw(results, self.name, part.by_yaw, layout)
            yield Place.RESULT, editing_sections.by_scene(results, self.name, part.by_yaw)
        if layout.timings:
            yield Place.RESULT, editing_sections.parts_of_time(results, self.name)
        if layout.timings and part.choice:
            yield (
                Place.RESULT,
                editing_sections.choice(results, self.name, part.choice, CHOSEN_BY),
            )

    def gallery(self, results: Results) -> Section | None:
        """Edited views side by side."""
        return editing_sections.side_by_side(results, self.name)


def run_method(
    work: Work,
    truth: EditTruth,
    names: Sequence[str],
    before: Gaussians,
    budget: Budget | None = None,
) -> EditedScene:
    """Edit a scene by the method of a cell.

    Args:
        work: of the cell, whose spec has ``method``, ``settings``, ``editor`` and ``edit``.
        truth: of the edit.
        names: of the views, the source first.
        before: the splats to edit.
        budget: limits of the method.
    """
    spec, world = work.spec, work.world
    with work.meter.stage("setup"):
        editor = load(work.cell.sources["editor"], spec["editor"])
    with tempfile.TemporaryDirectory() as folder:
        job = Job(
            before,
            [world.camera(name) for name in names],
            [truth.originals[name] for name in names],
            editor,
            spec["edit"]["target" if editor.guide == "depth" else "instruction"],
            with_source_words(spec["settings"], spec["edit"]["source"]),
            Path(folder),
            _warps(work, before, names),
            {a: [views[n] for n in names] for a, views in truth.answers.items()},
            budget,
            source_by_hand(work, truth, names[0]),
        )
        return EDITING_METHODS[spec["method"]].run(job)


def source_by_hand(work: Work, truth: EditTruth, source: str) -> Image | None:
    """The source view that a cell's spec has edited by hand: the first answer; None for none."""
    kind = work.spec.get("by_hand")
    if kind is None:
        return None
    answer = next(iter(truth.answers))
    return hand_made(
        kind,
        truth.originals[source],
        truth.answers[answer][source],
        truth.masks[answer][source],
        work.spec["seed"],
    )


@cache
def _compile(kind: Literal["2d", "3d"]) -> None:
    """Compile what renders, tunes and warps, so that a first edit's seconds do not hold it."""
    compile_kernels(kind)
    splats = Gaussians(
        kind, torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 2 + (kind == "3d")),
        torch.ones(1), torch.zeros(1, 1, 3),
    )  # fmt: skip
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), width=16, height=16, fov_y=40, up=(0, 1, 0))
    warp_view(splats, camera, camera).at((4, 4)).warp_tokens(torch.zeros(1, 16, 4))


class _Measure:
    """The figures of one edited scene.

    Args:
        work: the cell.
        truth: of the edit.
        names: of the views, the source first.
        before: the splats before the edit.
        result: of the method.
        encoders: by kind.
    """

    def __init__(
        self,
        work: Work,
        truth: EditTruth,
        names: list[str],
        before: Gaussians,
        result: EditedScene,
        encoders: Mapping[str, Any],
    ) -> None:
        self.work, self.truth, self.names = work, truth, names
        self.injected = float(result.counters.get("injected", 0.0))
        self.before, self.after, self.encoders = before, result.gaussians, encoders
        self.source = names[0]
        if not result.edited:
            method = f"method {work.spec['method']!r}"
            raise StudyError(
                f"{method} gave no edited view, expected at least one"
                if result.cut is None
                else f"budget: it ended {method} before its first edit; give more"
            )
        edited = {names[k]: _full(truth.originals[names[k]], v) for k, v in result.edited.items()}
        self.pictures = {"edit": edited, "render": self._renders(result.gaussians)}
        # A method that was cut short may not have edited the source: it shows no edit then.
        image = edited.get(self.source, truth.originals[self.source])
        self.judged = truth.judge({self.source: image})
        self.nearest = {k: self._nearest(pictures) for k, pictures in self.pictures.items()}
        self.neighbours = neighbours(work.world, work.spec["views"])

    def record(self) -> EditResult:
        """Add the figures of every target to the work; return the rest."""
        work, truth = self.work, self.truth
        figures: dict[str, dict[str, float]] = {name: {} for name in self.names[1:]}
        overall: dict[str, str | None] = {}
        for kind, images in self.pictures.items():
            part = truth.of(list(images))
            overall[kind], fidelity = metrics.edit_fidelity(
                images, part.answers, part.masks, originals=part.originals
            )
            for name, row in figures.items():
                row |= self._fidelity(kind, fidelity.get(name))
                row |= self._agreement(kind, name, overall[kind])
        embedded = self._embedded()
        both = [name for name in self.pictures["edit"] if name != self.source]
        psnr = metrics.edit_psnr(
            {name: self.pictures["edit"][name] for name in both},
            {name: self.pictures["render"][name] for name in both},
            # Sampled splats lie on surfaces: the sky has none.
            {name: self._hits(name).valid for name in both},
        )
        errors = dict(zip(psnr.views, zip(psnr.psnr, psnr.mse, strict=True), strict=True))
        for name, row in figures.items():
            decibels, error = errors.get(name, (math.nan, math.nan))
            row |= {"image.psnr.edit_render": decibels, "image.mse.edit_render": error}
            row |= embedded[name]
            row |= self._depth(name)
            edit = work.spec["edit"]["name"]
            work.add(f"{edit}/{name}", row, partial(self._draw, name))
        return EditResult(
            work.spec["edit"]["name"],
            work.spec["edit"]["instruction"],
            self.judged,
            truth.judge(self.pictures["edit"]),
            self.nearest,
            overall,
            psnr.pooled,
            len(self.pictures["edit"]),
            self.injected,
        )

    def _nearest(self, images: Mapping[str, Image]) -> dict[str, str | None]:
        part = self.truth.of(list(images))
        return metrics.answers_by_view(images, part.answers, part.union)

    def _pair(self, first: str, second: str) -> Any:
        return self.work.world.between(first, second)

    def _fidelity(self, kind: str, figures: Mapping[str, float] | None) -> dict[str, float]:
        if figures is None:
            figures = {}
        return {
            f"fidelity.{key}.{kind}{place}": figures.get(
                f"fidelity.{key}{'.inside' if place else ''}", math.nan
            )
            for key in FIDELITY
            for place in ("", "_inside")
        } | {
            f"fidelity.{key}.{kind}": figures.get(f"fidelity.{key}", math.nan)
            for key in ("preserved_psnr", "preserved_mse")
        }

    def _agreement(self, kind: str, name: str, answer: str | None) -> dict[str, float]:
        """Agreement of a target with the source, and with its neighbour; NaN where it was not
        edited or the source's edit is not one.
        """
        keys = ("same_answer", "delta_e", "delta_e_floor", "delta_e_above")
        row = dict.fromkeys(
            [
                *(f"multiview.same_answer.{kind}{end}" for end in ("", "_seen")),
                *(f"multiview.{k}.{kind}{end}" for k in keys[1:] for end in ("", "_inside")),
                f"multiview.delta_e_above.{kind}_next",
            ],
            math.nan,
        )
        images, truth = self.pictures[kind], self.truth
        if not self.judged.done or answer is None or name not in images:
            return row
        pair = self._pair(self.source, name)
        own = self.nearest[kind][name]
        if truth.ambiguous:
            row[f"multiview.same_answer.{kind}"] = _equal(own, self.judged.answer)
            part = truth.of([name])
            seen = {name: truth.union[name] & pair.visible}
            if seen[name].sum() >= LEAST_PIXELS:
                there = metrics.answers_by_view({name: images[name]}, part.answers, seen)[name]
                row[f"multiview.same_answer.{kind}_seen"] = _equal(there, self.judged.answer)
        for end, mask in (("", None), ("_inside", truth.masks[answer][name])):
            figures = self._above(images, answer, self.source, name, mask)
            for key in keys[1:]:
                row[f"multiview.{key}.{kind}{end}"] = figures[f"multiview.{key}"]
        other = self.neighbours[name]
        if other in images:
            mask = truth.masks[answer][name]
            figures = self._above(images, answer, other, name, mask)
            row[f"multiview.delta_e_above.{kind}_next"] = figures["multiview.delta_e_above"]
        return row

    def _above(
        self, images: Mapping[str, Image], answer: str, first: str, second: str, mask: Any
    ) -> dict[str, float]:
        """Disagreement of two views above its floor; NaN where fewer than :data:`LEAST_PIXELS` are
        compared.
        """
        true = self.truth.answers[answer]
        figures = metrics.above_floor(
            (images[first], images[second]),
            (true[first], true[second]),
            self._pair(first, second),
            mask=mask,
        )
        few = figures["multiview.pixels"] < LEAST_PIXELS
        return dict.fromkeys(figures, math.nan) if few else figures

    def _embedded(self) -> dict[str, dict[str, float]]:
        """The paper's similarities of renders; none without encoders."""
        targets = self.names[1:]
        rows: dict[str, dict[str, float]] = {name: {} for name in targets}
        renders = [self.pictures["render"][name] for name in targets]
        source = self.pictures["edit"].get(self.source)
        values: dict[str, Any] = {}
        if (clip := self.encoders.get("clip")) is not None:
            words = clip.texts([self.work.spec["edit"][key] for key in ("source", "target")])
            images = clip.images(renders)
            befores = clip.images([self.truth.originals[name] for name in targets])
            values["clip_similarity"] = metrics.clip_similarity(images, words[1])
            values["clip_directional"] = metrics.directional_similarity(
                befores, images, words[0], words[1]
            )
            if source is not None:
                values["clip_image"] = metrics.image_similarity(clip.images([source]), images)
        if source is not None and (dino := self.encoders.get("dino")) is not None:
            values["dino_image"] = metrics.image_similarity(
                dino.images([source]), dino.images(renders)
            )
        for key, similarity in values.items():
            for name, value in zip(targets, similarity.values, strict=True):
                rows[name][f"embedding.{key}.render"] = float(value)
        return rows

    def _hits(self, name: str) -> Hits:
        return self.work.world.geometry.trace(self.work.world.camera(name))

    def _depth(self, name: str) -> dict[str, float]:
        hits = self._hits(name)
        camera = self.work.world.camera(name)
        row = {}
        for when, model in (("before", self.before), ("after", self.after)):
            _, error = surface_error(model, camera, hits)
            row[f"depth.abs_rel.{when}"] = error["depth.abs_rel"]
        return row

    def _renders(self, model: Gaussians) -> dict[str, Image]:
        return {name: self._render(model, name) for name in self.names}

    def _render(self, model: Gaussians, name: str, least: int = 1) -> Image:
        """(H, W, 3) of a view of splats, at a whole multiple of its size and at least so wide."""
        from attnwarp.methods.scene import near_of, render_picture

        cameras = {own: self.work.world.camera(own) for own in self.names}
        near, camera = near_of(list(cameras.values()), self.before), cameras[name]
        times = -(-least // camera.width)
        larger = camera.resize(times * camera.width, times * camera.height)
        return render_picture(model, larger, near, "auto")

    def _draw(self, name: str) -> dict[str, bytes]:
        """JPEG files of a view: before, the source's edit, the edited view, its render, and the
        truth of the source's answer."""
        answer = self.judged.answer
        images = {
            "before": self.truth.originals[name],
            "by hand": source_by_hand(self.work, self.truth, self.source),
            "source edit": self.pictures["edit"].get(self.source),
            "edited": self.pictures["edit"].get(name),
            "render": self._render(self.after, name, pictures.WIDTH),
            "truth": None if answer is None else self.truth.answers[answer][name],
        }
        return {
            content.replace(" ", "-"): pictures.jpeg(pictures.enlarged(image))
            for content, image in images.items()
            if image is not None
        }


def settings_of(study: Study, variant: Variant, seed: int) -> dict[str, Any]:
    """The settings of a variant's method: a preset, the study's fields, the variant's, and the
    fields of its warp.

    Raises:
        ValueError: an unknown preset or field, or a value out of range.
    """
    own, shared = variant.part(VariantPart), study.part(StudyPart).editing.options
    fields = {**shared, **own.options}
    if "seed" in fields:
        raise ValueError("options.seed: the seeds are the study's own; set seeds there")
    presets = (own.options.get("preset"), variant.preset, fields.pop("preset", None))
    name = next((preset for preset in presets if preset is not None), None)
    warp = {f"warp.{key}": value for key, value in variant.set.items()}
    return EDITING_METHODS[own.method].settings(name, {**fields, **warp}, seed)


def _reference(variant: Variant) -> str | None:
    """The name of the variant whose seconds limit this one."""
    budget = variant.part(VariantPart).budget
    return None if budget is None else budget.seconds_of


_SHARED = ("probe", "protocol", "scene", "size", "views", "seed", "edit", "encoders")
"""Entries of a cell's spec that all variants share."""


def _decisive(spec: Json) -> Json:
    """Entries of a cell's spec that decide its method's run; the encoders measure it afterwards."""
    return {key: value for key, value in spec.items() if key != "encoders"}


def _own_seconds(result: EditedScene) -> float:
    return sum(result.seconds.get(part, 0.0) for part in OWN_WORK)


def editor_of(study: Study, variant: Variant) -> EditorPart:
    """The variant's own editor, else the study's."""
    return variant.part(VariantPart).editor or study.part(StudyPart).editing.editor


def editor_identity(editor: EditorPart) -> Json:
    """Parts of an editor that decide its pictures: its files and its guidance, not its folder."""
    guidance = {"text": editor.text_guidance, "image": editor.image_guidance}
    return {"sha256": _files_digest(editor.name), "guidance": guidance}


@lru_cache
def _files_digest(name: str) -> str:
    """SHA-256 of an editor's files.

    Raises:
        StudyError: there is none of that name.
    """
    from attnwarp.editing.small import SUMS, folders_of

    try:
        folder, control = folders_of(name)
    except InputError as error:
        raise StudyError(str(error)) from None
    files = {path.relative_to(folder): path for path in folder.rglob("*")}
    if control is not None and control != folder / "controlnet":
        # As if it stood there; a ControlNet that does is not read.
        files = {place: path for place, path in files.items() if place.parts[0] != "controlnet"}
        files |= {"controlnet" / path.relative_to(control): path for path in control.rglob("*")}
    sums = [
        [place.as_posix(), hashlib.sha256(path.read_bytes()).hexdigest()]
        for place, path in sorted(files.items())
        if path.suffix in (".json", ".safetensors") and path.name != SUMS
    ]
    return hashlib.sha256(json.dumps(sums).encode()).hexdigest()


@lru_cache(maxsize=2)
def _loaded(
    name: str, guidance: tuple[tuple[str, float], ...], device: str
) -> InstructPix2Pix | DepthControlNet:
    from attnwarp.editing.small import guide_of, load_editor

    given: dict[str, Any] = {f"{kind}_guidance": value for kind, value in guidance}
    if guide_of(name) == "depth" and "text_guidance" in given:
        given["guidance"] = given.pop("text_guidance")
    return load_editor(name, device=device, **given)


def load(name: str, planned: Json, device: str = "cpu") -> InstructPix2Pix | DepthControlNet:
    """An editor whose identity is the planned one.

    Raises:
        StudyError: its files have changed since the run was planned.
        InputError: no such device.
    """
    if _files_digest(name) != planned["sha256"]:
        raise StudyError(
            f"editor {name!r}: its files have changed since the run was planned; start the run"
            " again"
        )
    given = planned["guidance"].items()
    guidance = tuple((kind, value) for kind, value in given if value is not None)
    return _loaded(name, guidance, device)


def edits_of(study: Study, scene: Scene) -> Iterator[Json]:
    """Entries for a cell's spec, one for each of a scene's edits.

    Raises:
        StudyError: the study names an edit or an answer that the scene lacks.
    """
    own = {edit.name: edit for edit in scene.edits}
    wanted = study.part(StudyPart).editing.edits.get(scene.name) or dict.fromkeys(own)
    if not wanted:
        raise StudyError(f"probes.editing: scene {scene.name!r} names no edits; leave it out")
    for key, words in wanted.items():
        title, _, answer = key.partition("=")
        if title not in own:
            raise StudyError(
                f"editing.edits.{scene.name}: no edit {title!r}{did_you_mean(title, own)}"
            )
        try:
            answers = answers_of(scene, key)
        except ValueError as error:
            raise StudyError(f"editing.edits.{scene.name}: {error}") from None
        edit = own[title]
        targets = [one.target for one in edit.answers if one.name == answer]
        yield {
            "name": key,
            "instruction": words or edit.instruction,
            "source": edit.source,
            "target": targets[0] if targets else edit.target,
            "answers": [[one, scene.edited(title, of).content_hash] for one, of in answers],
        }


def _warps(work: Work, model: Gaussians, names: Sequence[str]) -> Any:
    """Warps by exact depth, or with the exact mask; None for the method's own."""
    spec, world = work.spec, work.world
    if spec["geometry"] == "splats" and spec["mask"] == "rules":
        return None
    warp = spec["settings"].get("warp")
    settings = PRESETS["corrected"] if warp is None else WarpSettings.from_dict(warp)
    made: dict[tuple[int, int], WarpedView] = {}

    def of(source: int, target: int) -> WarpedView:
        if (source, target) not in made:
            pair = world.between(names[source], names[target])
            if spec["geometry"] == "truth":
                view = warp_truth(world, pair, settings)
            else:
                view = warp_view(model, pair.source, pair.target, settings, warn_empty=False)
            if spec["mask"] == "truth":
                visible = torch.from_numpy(np.ascontiguousarray(pair.visible))
                view = replace(view, mask=visible & view.correspondence.defined, _at={})
            made[source, target] = view
        return made[source, target]

    return of


def _full(original: Image, edited: npt.NDArray[np.uint8]) -> Image:
    """An edited view at the size of the original."""
    from attnwarp.methods.pictures import enlarged_change

    return enlarged_change(original, edited.astype(np.float32) / np.float32(255))


def _equal(answer: str | None, expected: str | None) -> float:
    return math.nan if answer is None else float(answer == expected)
