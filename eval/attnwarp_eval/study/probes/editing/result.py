"""Result of an edit: its record, and the figures of its views against the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from attnwarp import Gaussians
from attnwarp_eval import metrics
from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.splats.fitted import rendered_error
from attnwarp_eval.study.probe import Work
from attnwarp_eval.study.record import Json, with_nan
from attnwarp_eval.study.schema import StudyError
from attnwarp_eval.study.shared import pictures
from attnwarp_eval.study.shared.edit_figures import EditFigures, full_size
from attnwarp_eval.study.shared.edit_truth import EditTruth, Judgement, neighbours
from attnwarp_eval.study.shared.editing_methods import EditedScene

if TYPE_CHECKING:
    from attnwarp_eval.two_view import Hits

Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class EditResult:
    """Entries of a cell's record besides the figures of its views.

    Attributes:
        source: content description of the source's edit.
        alone: the same for all edited views together, the source included.
        answers: nearest answer by "edit" or "render", then by view; None if none of the object is
            visible.
        overall: by "edit" and "render", the nearest answer to all views together.
        edit_psnr: dB, edited views against renders, pooled over pixels with a surface.
        injected: mean share of the targets' pixels with injected features; 0 without a warp.
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

    @property
    def comparable(self) -> bool:
        """True if the source's edit succeeded; comparisons use no other edits."""
        return self.source.done

    def to_json(self) -> Json:
        """The record's entry ``edit``."""
        return {"edit": dict(without_nan(asdict(self)))}

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
        return cls(**{**data, **judgements, **own})


class Measurement:
    """The figures of one edited scene.

    Args:
        names: names of the views, the source first.
        before: the splats before the edit.
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
        self.drift = result.drift
        self.injected = float(result.counters.get("injected", 0.0))
        self.before, self.after, self.encoders = before, result.gaussians, encoders
        self.source = names[0]
        if not result.edited:
            raise StudyError(
                f"method {work.spec['method']!r} gave no edited view, expected at least one"
            )
        edited = {
            names[k]: full_size(truth.originals[names[k]], v) for k, v in result.edited.items()
        }
        self.pictures = {"edit": edited, "render": self._renders(result.gaussians)}
        # A method may leave the source unedited: it then shows no edit.
        image = edited.get(self.source, truth.originals[self.source])
        self.judged = truth.judge({self.source: image})
        self.figures = {
            kind: EditFigures(work.world, truth, self.source, pictures, self.judged, kind)
            for kind, pictures in self.pictures.items()
        }
        self.neighbours = neighbours(work.world, work.spec["views"])

    def record(self) -> EditResult:
        """Add the figures of every target to the work; return the record's extra."""
        work, truth = self.work, self.truth
        figures: dict[str, dict[str, float]] = {name: {} for name in self.names[1:]}
        for kind, of in self.figures.items():
            for name, row in figures.items():
                row |= of.row(name)
                row[f"multiview.delta_e_above.{kind}_next"] = of.next_to(
                    self.neighbours[name], name
                )
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
            row |= self._depth(name) | {"edit.drift": self.drift}
            edit = work.spec["edit"]["name"]
            work.add(f"{edit}/{name}", row, partial(self._draw, name))
        return EditResult(
            work.spec["edit"]["name"],
            work.spec["edit"]["instruction"],
            self.judged,
            truth.judge(self.pictures["edit"]),
            {kind: of.nearest for kind, of in self.figures.items()},
            {kind: of.fidelity[0] for kind, of in self.figures.items()},
            psnr.pooled,
            len(self.pictures["edit"]),
            self.injected,
        )

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
            error = rendered_error(model, camera, hits)
            row[f"depth.abs_rel.{when}"] = error["depth.abs_rel"]
        return row

    def _renders(self, model: Gaussians) -> dict[str, Image]:
        return {name: self._render(model, name) for name in self.names}

    def _render(self, model: Gaussians, name: str, least: int = 1) -> Image:
        """(H, W, 3) of a view of splats, at a multiple of its size, at least ``least`` wide."""
        from attnwarp.methods.scene import near_of, render_picture

        cameras = {own: self.work.world.camera(own) for own in self.names}
        near, camera = near_of(list(cameras.values()), self.before), cameras[name]
        times = -(-least // camera.width)
        larger = camera.resize(times * camera.width, times * camera.height)
        return render_picture(model, larger, near, "auto")

    def _draw(self, name: str) -> dict[str, bytes]:
        """JPEG files of a view: unedited, the source's edit, the edited view, its render, and the
        truth of the source's answer."""
        answer = self.judged.answer
        images = {
            "before": self.truth.originals[name],
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
