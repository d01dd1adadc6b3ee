"""Methods that edit a scene, by the name that a study's variant gives as ``method``.

A method gets a :class:`Job` and gives an :class:`EditedScene`. A new one is one line in
:data:`EDITING_METHODS`, or an entry that a plugin adds to it (docs/project/extending.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from attnwarp.encoders import load_encoder
from attnwarp.methods import PRESETS, AttentionWarpingSettings
from attnwarp.methods.by_warps import CarriedSettings, SourceSettings
from attnwarp.reporting import SILENT, Reporter

if TYPE_CHECKING:
    from attnwarp.camera import Camera
    from attnwarp.editing.editor import Editor
    from attnwarp.editing.recording import Recording
    from attnwarp.gaussians import Gaussians
    from attnwarp.methods import Budget, Options, Round
    from attnwarp.methods.algorithms.attention_warping import AttentionWarping
    from attnwarp.warp import WarpedView

Image = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]


SOURCE_WORDS = "{source}"
"""Stands in a method's setting ``source_prompt`` for the words that describe the scene before."""


def needs_source_words(settings: Mapping[str, Any]) -> bool:
    """Return True if a method's settings take the words that describe the scene before."""
    return SOURCE_WORDS in (settings.get("source_prompt") or "")


def with_source_words(settings: dict[str, Any], words: str) -> dict[str, Any]:
    """A method's settings with these words in their place, if they have one.

    Example:
        >>> with_source_words({"steps": 20, "source_prompt": "{source}"}, "a bear")
        {'steps': 20, 'source_prompt': 'a bear'}
        >>> with_source_words({"steps": 20}, "a bear")
        {'steps': 20}
    """
    if not needs_source_words(settings):
        return settings
    return {**settings, "source_prompt": settings["source_prompt"].replace(SOURCE_WORDS, words)}


@dataclass(frozen=True, eq=False)
class Donor:
    """Another scene, whose source's features a control injects.

    Attributes:
        editor: editor of its source, with the same layers as the job's.
        picture: (H, W, 3) sRGB in [0, 1], its source before the edit.
    """

    editor: Editor
    picture: Image


@dataclass(frozen=True, eq=False)
class Job:
    """A scene to edit.

    Attributes:
        gaussians: the scene before the edit.
        cameras: cameras of the views, the source first; all of one size (H, W).
        images: (H, W, 3) sRGB in [0, 1], the views before the edit.
        instruction: in words; a description of the result for an editor that is guided by depth.
        settings: return value of the method's ``settings``.
        folder: for the method's files; removed afterwards.
        warps: the warp from the source to a target by their numbers, in place of the method's own.
        truth: the true edited views by answer, in the order of ``cameras``. Only methods that
            bound others may look at it.
        budget: limits of the method; None for none.
        donor: donor of the features that targets get in place of the source's; None for the
            source's.
        segments: (H, W) share of each view that is edited, outside which nothing may change; None
            for everywhere.
        masks: (H, W) bool of each view, or None: False where its picture is to be ignored; see
            :class:`attnwarp.fit.Views`.
        report: receives how the method stands.
        load: gives encoders, as :func:`attnwarp.encoders.load_encoder`.
    """

    gaussians: Gaussians
    cameras: Sequence[Camera]
    images: Sequence[Image]
    editor: Editor
    instruction: str
    settings: dict[str, Any]
    folder: Path
    warps: Callable[[int, int], WarpedView] | None
    truth: Mapping[str, Sequence[Image]]
    budget: Budget | None = None
    donor: Donor | None = None
    segments: Sequence[npt.NDArray[Any]] | None = None
    source: int = 0
    masks: Sequence[npt.NDArray[np.bool_] | None] = ()
    report: Reporter = SILENT
    load: Callable[..., Any] = load_encoder

    @property
    def options(self) -> Options:
        """Options that every method of the library takes by name."""
        return {
            "folder": self.folder, "budget": self.budget, "segments": self.segments,
            "masks": self.masks, "report": self.report, "load": self.load,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class EditedScene:
    """The result of a method.

    Attributes:
        gaussians: the edited splats.
        edited: (h, w, 3) uint8 sRGB by the view's number, the source among them; views that the
            method did not edit are left out.
        seconds: by part. ``edit``, ``source``, ``warp`` and ``tune`` are the method's own work.
        counters: counts of work, such as ``network_rows``.
        cut: the limit of the budget that ended the method; None for a whole run.
        rounds: the views of each round, as planned; empty where a method does not tell them.
        drift: px by which the edit of the source, or of the view that moved most, moves a corner;
            NaN if it can't be told.
    """

    gaussians: Gaussians
    edited: Mapping[int, Bytes]
    seconds: Mapping[str, float]
    counters: Mapping[str, float]
    cut: str | None = None
    rounds: Sequence[Round] = ()
    drift: float = math.nan


@dataclass(frozen=True)
class Method:
    """Settings and run of a method.

    Attributes:
        settings: complete settings as JSON, from a preset's name (None where the study names none),
            the fields of a study and a variant, and the seed. ValueError: an unknown field or a
            value out of range.
        edited: how many of a number of views it edits at most with these settings; None where that
            is not known.
        needs_truth: whether it reads the true edited views.
    """

    settings: Callable[[str | None, dict[str, Any], int], dict[str, Any]]
    run: Callable[[Job], EditedScene]
    edited: Callable[[Mapping[str, Any], int], int] | None = None
    needs_truth: bool = False


def _attention_warping(job: Job) -> EditedScene:
    if job.donor is not None:
        return _with_features_of(job, job.donor)
    return _edited_by("attention_warping", job)


def _with_features_of(job: Job, donor: Donor) -> EditedScene:
    """Attention warping of targets with features of the donor's source, edited alike."""
    from attnwarp.methods.algorithms.attention_warping import AttentionWarping
    from attnwarp.methods.base import ViewEdit, run

    recordings: list[Recording] = []

    class Swapping(AttentionWarping):
        """Record in a first run, and take that recording in a second one."""

        def edit_source(self, *rest: Any) -> list[ViewEdit]:
            edits = super().edit_source(*rest)
            own = self.recorded
            if own.recording is not None:
                recordings.append(own.recording)
                self.keep(replace(own, recording=recordings[0]))
            return edits

    settings = AttentionWarpingSettings.from_dict(job.settings)
    run(
        "attention_warping", lambda work, s: Swapping(work, s, 0, None, None, "cpu"),
        AttentionWarpingSettings, job.gaussians, [job.cameras[job.source]], [donor.picture],
        donor.editor, job.instruction, replace(settings, iterations=0), load=job.load,
    )  # fmt: skip
    return run_warping(job, Swapping)


def run_warping(job: Job, kind: type[AttentionWarping]) -> EditedScene:
    """Edit a scene by attention warping of another class, with the settings of the job."""
    from attnwarp.methods.base import run

    return _edited(
        run(
            "attention_warping",
            lambda work, s: kind(work, s, job.source, None, job.warps, "cpu"),
            AttentionWarpingSettings, job.gaussians, job.cameras, job.images, job.editor,
            job.instruction, AttentionWarpingSettings.from_dict(job.settings), **job.options,
        )
    )  # fmt: skip


def _edited(result: Any) -> EditedScene:
    found = result.drift.get("drift")
    return EditedScene(
        result.gaussians, result.edited, result.seconds, result.counters, result.cut, result.rounds,
        found["largest"] if found and "right" in found else math.nan,
    )  # fmt: skip


def true_pictures(job: Job) -> EditedScene:
    """Take the first answer's true pictures in every view, and tune splats on them: the ceiling.

    Stages, their views and their tuning are those of ``attention_warping``.

    Raises:
        ValueError: a budget or a donor, neither of which means anything here.
    """
    from attnwarp.methods.algorithms.attention_warping import AttentionWarping
    from attnwarp.methods.base import ViewEdit

    for name in ("budget", "donor"):
        if getattr(job, name) is not None:
            raise ValueError(f"{name}: got one, but 'true pictures' edits nothing; leave it out")
    pictures = next(iter(job.truth.values()))

    class TruePictures(AttentionWarping):
        """Views become their true pictures."""

        def edit_source(self, *_: Any) -> list[ViewEdit]:
            return self.edit_targets(0, [self.source])

        def edit_targets(self, stage: int, batch: Sequence[int], *_: Any) -> list[ViewEdit]:
            return [ViewEdit(pictures[view], {"injected": 0.0}) for view in batch]

    result = run_warping(replace(job, warps=None), TruePictures)
    return replace(result, counters={**result.counters, "network_rows": 0})


def _warped_views(settings: Mapping[str, Any], views: int) -> int:
    """The source, and the views that the stages draw."""
    from attnwarp.methods.stages import draw_stages

    s = AttentionWarpingSettings.from_dict(dict(settings))
    return 1 + len(set().union(*draw_stages(range(1, views), s)))


def _drawn_views(settings: Mapping[str, Any], views: int) -> int:
    """All views, or as many as the rounds draw."""
    from attnwarp.methods.work import parts_of

    if "views" not in settings:
        return views
    rounds = parts_of(settings["iterations"], settings["every"]) if "every" in settings else [0]
    return min(views, settings["views"] * len(rounds))


def _method(name: str) -> Method:
    """A method of :mod:`attnwarp.methods`."""

    def settings(wanted: str | None, fields: dict[str, Any], seed: int) -> dict[str, Any]:
        from attnwarp.methods import preset

        return dict(preset(name, wanted, **fields, seed=seed).to_dict())

    return Method(settings, partial(_edited_by, name), edited=_drawn_views)


def _edited_by(name: str, job: Job) -> EditedScene:
    """A method that starts at a source gets the job's; one that carries edits, its warps too."""
    from attnwarp import methods

    kind = type(next(iter(PRESETS[name].values())))
    given: dict[str, Any] = {**job.options}
    if issubclass(kind, CarriedSettings | AttentionWarpingSettings):
        given["warps"] = job.warps
    if issubclass(kind, SourceSettings | AttentionWarpingSettings):
        given["source"] = job.source
    return _edited(
        methods.METHODS[name](
            job.gaussians, job.cameras, job.images, job.editor, job.instruction,
            kind.from_dict(job.settings), **given,
        )
    )  # fmt: skip


_BY_NAME = {name: _method(name) for name in PRESETS}

EDITING_METHODS: dict[str, Method] = {
    **_BY_NAME,
    "attention_warping": replace(
        _BY_NAME["attention_warping"], run=_attention_warping, edited=_warped_views
    ),
    "true pictures": Method(
        _BY_NAME["attention_warping"].settings, true_pictures, needs_truth=True
    ),
}
"""Every method by name, as in :mod:`attnwarp.methods`. ``attention_warping`` with ``a0: 0`` is the
control."""
