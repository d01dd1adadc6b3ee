"""A study's methods on a person's own capture, of which no truth is known.

Figures that need no true pictures are computed; all others are left out by name. Each method has a
folder of its own and goes on there after an interruption.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from attnwarp.devices import device_of
from attnwarp.editing.small import guide_of
from attnwarp.errors import InputError, InputWarning
from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval.document import write
from attnwarp_eval.document.model import Gallery, Picture, Report, Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.files import write_atomic, write_picture
from attnwarp_eval.study.probe_report import report_of
from attnwarp_eval.study.schema import Study, Variant
from attnwarp_eval.study.shared import edits, fits, method_run
from attnwarp_eval.study.shared.editing_methods import (
    EDITING_METHODS,
    EditedScene,
    Job,
    needs_source_words,
    with_source_words,
)
from attnwarp_eval.study.shared.encoders import EncodersPart
from attnwarp_eval.study.store import Store
from attnwarp_eval.user_images import measure

if TYPE_CHECKING:
    from attnwarp.camera import Camera
    from attnwarp.editing.editor import Guide
    from attnwarp.fit import Views
    from attnwarp.gaussians import Gaussians
    from attnwarp.methods import Result

WITHOUT_TRUTH = ("image.", "embedding.")
"""Beginnings of the names of figures that need no true pictures."""

GUIDES: dict[Guide, tuple[str, str]] = {
    "picture": ("--editor", "a picture"),
    "depth": ("--depth-editor", "depth maps"),
}
"""The option that names an editor, and what that editor takes, by its guide."""

COUNTS = (
    "Edit PSNR is of edited views alone, and more edits cost more; options.views_per_stage of a"
    " variant with attention_warping, or options.views of one that draws views, makes them equal"
)
"""Meaning of different numbers of edited views, and the remedy."""

PICTURED = 4
"""Views side by side in the report, evenly spread."""


@dataclass(frozen=True)
class Words:
    """Words of an edit.

    Attributes:
        instruction: for editors that are told what to change.
        target: description of the edited scene, for editors guided by depth and for CLIP; None:
            depth editors get the instruction, and CLIP's figures are left out.
        source: description of the scene before, for CLIP's direction and for methods that invert
            with it; None leaves both out.
    """

    instruction: str
    target: str | None = None
    source: str | None = None


@dataclass(frozen=True)
class Editors:
    """Editors of single views.

    Attributes:
        picture, depth: in place of the study's editors that take a picture, or depth maps: a name
            or folders, as :func:`attnwarp.editing.small.load_editor` takes them; None keeps the
            study's. A study's own guidance stays.
        device: "cpu" or "cuda".

    Raises:
        InputError: no such device or editor, or one of another guide.
    """

    picture: str | None = None
    depth: str | None = None
    device: str = "cpu"

    @property
    def named(self) -> dict[Guide, str]:
        """Those in place of the study's, by guide."""
        given: dict[Guide, str | None] = {"picture": self.picture, "depth": self.depth}
        return {guide: name for guide, name in given.items() if name is not None}

    def __post_init__(self) -> None:
        device_of(self.device)
        for guide, name in self.named.items():
            option, wanted = GUIDES[guide]
            if guide_of(name) != guide:
                other, actual = GUIDES[guide_of(name)]
                raise InputError(
                    f"{option} {name}: takes {actual}, expected an editor that takes {wanted};"
                    f" name it by {other}"
                )

    def of(self, study: Study, variant: Variant) -> edits.EditorPart:
        """The editor of a variant."""
        own = edits.editor_of(study, variant)
        if not self.named:
            return own
        return own.model_copy(update={"name": self.named.get(guide_of(own.name), own.name)})


@dataclass
class Comparison:
    """The result of all methods.

    Attributes:
        rows: by variant, its figures and costs.
        left_out: variants and figures -> why.
    """

    rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)


def needs_truth(variant: Variant) -> str | None:
    """Reason why a variant cannot run without a scene whose truth is known; None where it can."""
    own = variant.part(edits.VariantPart)
    if own.method == "true pictures":
        return "its edits are the true pictures"
    if own.mask == "truth" or variant.geometry == "truth":
        return "its warp is the true one"
    if variant.part(fits.VariantPart).fitted:
        return "its splats are fitted to true pictures"
    return None


def compare(
    study: Study,
    views: Views,
    splats: Gaussians,
    words: Words,
    out: Path,
    report: Reporter = SILENT,
    *,
    editors: Editors = Editors(),
) -> Comparison:
    """Run every variant of a study on a capture, measure it, and write a report.

    Args:
        study: with the probe ``editing``.
        views: pictures and cameras, the source first.
        splats: the scene before the edit.
        out: folder of ``captured.json``, ``.md`` and ``.html``, and of a folder for each variant.
        editors: editors of single views.

    Raises:
        InputError: no variant that can run without truth, or one whose folder holds another run;
            an editor for variants that the study lacks.
    """
    names = study.probes.get("editing", [])
    result = Comparison()
    for name in names:
        if (reason := needs_truth(study.variants[name])) is not None:
            result.left_out[f"variant {name}"] = reason
        elif words.source is None and needs_source_words(
            edits.settings_of(study, study.variants[name], study.seeds[0])
        ):
            result.left_out[f"variant {name}"] = "it inverts with the words of --source-prompt"
    usable = [name for name in names if f"variant {name}" not in result.left_out]
    if not usable:
        raise InputError(f"{study.name}: no variant of the probe editing runs without truth")
    parts = {name: editors.of(study, study.variants[name]) for name in usable}
    for guide, editor_name in editors.named.items():
        if editor_name not in {part.name for part in parts.values()}:
            option, wanted = GUIDES[guide]
            raise InputError(
                f"{option} {editor_name}: no variant of {study.name} has an editor that takes"
                f" {wanted}"
            )
    # Variants whose seconds limit others come first.
    usable.sort(key=lambda name: _reference(study.variants[name]) is not None)
    result.left_out |= {
        title: f"{metric} needs the true edited views or the true surface"
        for title, metric in report_of("editing").columns.items()
        if not metric.startswith(WITHOUT_TRUTH)
    }
    _warn_of_counts(study, usable, len(views.cameras))
    originals = write_originals(views, out / "originals")
    seconds: dict[str, float] = {}
    for place, name in enumerate(usable):
        report.step(place, len(usable), name)
        folder = out / f"variant-{names.index(name) + 1}"
        editor = method_run.load(
            parts[name].name, edits.editor_identity(parts[name]), editors.device
        )
        edited = _edit(study, name, editor, views, splats, words, folder / "run", seconds)
        seconds[name] = sum(edited.seconds.get(part, 0.0) for part in method_run.PARTS)
        write_pictures(views.cameras, splats, edited, originals, folder)
        page = _page(folder / "run", splats, views.cameras, originals, editor, parts[name].name)
        result.rows[name] = _measured(study, edited, words, folder, out / "originals", result)
        result.rows[name] |= {
            "editor": parts[name].name,
            "folder": folder.name,
            "page": page,
            "seconds": seconds[name],
            "network_rows": edited.counters.get("network_rows", math.nan),
            "edited_views": len(edited.edited),
            "cut": edited.cut,
        }
    report.step(len(usable), len(usable), "report")
    _write(study, words, views.cameras, result, out)
    return result


def _warn_of_counts(study: Study, names: Sequence[str], views: int) -> None:
    """Warn before anything is edited where methods edit different numbers of views."""
    counts = {}
    for name in names:
        variant = study.variants[name]
        method = EDITING_METHODS[variant.part(edits.VariantPart).method]
        if method.edited is not None:
            counts[name] = method.edited(edits.settings_of(study, variant, study.seeds[0]), views)
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{name} {count}" for name, count in counts.items())
        warnings.warn(
            f"of {views} views, variants edit {listed}; {COUNTS}", InputWarning, stacklevel=2
        )


def _reference(variant: Variant) -> str | None:
    budget = variant.part(edits.VariantPart).budget
    return None if budget is None else budget.seconds_of


def write_originals(views: Views, folder: Path) -> list[npt.NDArray[np.float32]]:
    """(H, W, 3) pictures over black, also written as files."""
    images = [views.target(k, np.zeros(3)).numpy() for k in range(len(views.cameras))]
    for k, image in enumerate(images):
        write_picture(folder / f"{_name(k)}.png", _bytes(image))
    return images


def _name(view: int) -> str:
    return f"view-{view:04d}"


def _bytes(image: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    return np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)


def _edit(
    study: Study,
    name: str,
    editor: Any,
    views: Views,
    splats: Gaussians,
    words: Words,
    folder: Path,
    seconds: dict[str, float],
) -> EditedScene:
    from attnwarp.methods import Budget

    variant = study.variants[name]
    own = variant.part(edits.VariantPart)
    settings = with_source_words(
        edits.settings_of(study, variant, study.seeds[0]), words.source or ""
    )
    if settings.get("size") is None:
        settings["size"] = editor.own_size
    budget = None
    if own.budget is not None:
        limit = own.budget.seconds
        if own.budget.seconds_of is not None:
            if own.budget.seconds_of not in seconds:
                raise InputError(
                    f"variants.{name}.budget.seconds_of: {own.budget.seconds_of!r} is not"
                    " measured; add it to probes.editing"
                )
            limit = seconds[own.budget.seconds_of]
        budget = Budget(limit, own.budget.network_rows)
    text = words.target or words.instruction if editor.guide == "depth" else words.instruction
    images = [views.target(k, np.zeros(3)).numpy() for k in range(len(views.cameras))]
    folder.mkdir(parents=True, exist_ok=True)
    job = Job(splats, views.cameras, images, editor, text, settings, folder, None, {}, budget)
    return EDITING_METHODS[own.method].run(job)


def write_pictures(
    cameras: Sequence[Camera],
    before: Gaussians,
    edited: EditedScene | Result,
    originals: Sequence[npt.NDArray[np.float32]],
    folder: Path,
) -> None:
    """Renders of all views and the edited views, at the capture's size."""
    from attnwarp.methods.pictures import enlarged_change
    from attnwarp.methods.scene import near_of, render_picture

    near = near_of(cameras, before)
    for k, camera in enumerate(cameras):
        picture = render_picture(edited.gaussians, camera, near, "auto")
        write_picture(folder / "renders" / f"{_name(k)}.png", _bytes(picture))
    for k, pixels in edited.edited.items():
        picture = enlarged_change(originals[k], pixels.astype(np.float32) / np.float32(255))
        write_picture(folder / "edited" / f"{_name(k)}.png", _bytes(picture))


def _page(
    run: Path,
    before: Gaussians,
    cameras: Sequence[Camera],
    originals: Sequence[npt.NDArray[np.float32]],
    editor: Any,
    name: str,
) -> str | None:
    """The page of a method's run, by its path in the comparison's folder; None for a method from
    outside that leaves no such run.
    """
    from attnwarp.editing.small import bundled
    from attnwarp.methods.base import workdir_of
    from attnwarp.methods.page import PAGE, show_edit
    from attnwarp.workdir import MANIFEST

    folder = workdir_of(run)
    if not folder.has(MANIFEST):
        return None
    if not folder.has(PAGE):
        control = editor if name in bundled() else None
        show_edit(folder, before, cameras, originals, editor=control)
    return f"{run.parent.name}/{run.name}/{PAGE}"


def _measured(
    study: Study,
    edited: EditedScene,
    words: Words,
    folder: Path,
    originals: Path,
    result: Comparison,
) -> dict[str, Any]:
    source = folder / "edited" / f"{_name(0)}.png"
    inputs = measure.Inputs(
        renders=folder / "renders",
        edited=folder / "edited",
        originals=originals,
        source_edit=source if 0 in edited.edited else None,
        prompt=words.target,
        source_prompt=words.source,
    )
    encoders: dict[Any, str | None] = {
        str(kind): name for kind, name in study.part(EncodersPart).encoders.items()
    }
    done = measure.measure(inputs, encoders, Store(folder / "measured"))
    result.left_out |= {
        title: why for title, why in done.missing.items() if title not in result.left_out
    }
    return {"figures": {row.title: row.value for row in done.rows}}


def _write(
    study: Study, words: Words, cameras: Sequence[Camera], result: Comparison, out: Path
) -> None:
    from attnwarp_eval.canonical_json import without_nan

    document = report(study, words, cameras, result)
    data = {
        "study": study.name,
        "words": vars(words),
        "views": [camera.name for camera in cameras],
        "variants": result.rows,
        "left_out": result.left_out,
    }
    text = json.dumps(without_nan(data), indent=1, ensure_ascii=False) + "\n"
    write_atomic(out / "captured.json", text.encode())
    write.write_files(document, out, "captured")


def report(study: Study, words: Words, cameras: Sequence[Camera], result: Comparison) -> Report:
    """The comparison as a document."""
    titles = list(dict.fromkeys(t for row in result.rows.values() for t in row["figures"]))
    costs = ["editor", "seconds", "network rows", "edited views", "cut short by"]
    rows = [
        [
            name,
            *(number(row["figures"].get(title, math.nan)) for title in titles),
            row["editor"],
            number(row["seconds"]),
            number(row["network_rows"]),
            str(row["edited_views"]),
            (row["cut"] or "–").replace("_", " "),
        ]
        for name, row in result.rows.items()
    ]
    table = Table(["variant", *titles, *costs], rows, timed=("seconds",))
    lacking = Table(["left out", "reason"], [list(entry) for entry in result.left_out.items()])
    count = len(cameras)
    views = sorted({k * count // min(PICTURED, count) for k in range(min(PICTURED, count))})
    pictures = []
    for view in views:
        edited = [
            Picture(f"{row['folder']}/renders/{_name(view)}.png", name)
            for name, row in result.rows.items()
        ]
        before = Picture(f"originals/{_name(view)}.png", "before")
        pictures.append((f"**{cameras[view].name or _name(view)}**", [before, *edited]))
    lead = [
        f"Study `{study.name}` on {count} views; instruction: {words.instruction}.",
        "One scene and one seed: figures without intervals, from which nothing follows for other"
        " scenes.",
    ]
    listed = [f"{name} `{row['page']}`" for name, row in result.rows.items() if row["page"]]
    pages = [f"The splats, and all else of a method: {', '.join(listed)}."] if listed else []
    counts = {name: row["edited_views"] for name, row in result.rows.items()}
    if len(set(counts.values())) > 1:
        numbers = ", ".join(f"{name} {edits}" for name, edits in counts.items())
        lead.append(f"**Variants edited different numbers of views: {numbers}.** {COUNTS}.")
    cut = [name for name, row in result.rows.items() if row["cut"]]
    if cut:
        lead.append(f"**Did not finish within their budget: {', '.join(cut)}.**")
    return Report(
        f"{study.title or study.name}, on a capture",
        lead,
        [
            Section("Figures that need no truth", tables=[table]),
            Section("Left out", ["What cannot be computed here, by name."], [lacking]),
            Section("Edited scenes", pages, gallery=Gallery(pictures)),
        ],
    )
