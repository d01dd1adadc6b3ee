"""Implementation of the command attnwarp edit: from photographs to an edited scene."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.command.marks import (
    HOW,
    MARKED,
    Marks,
    lifted_segments,
    pairs,
    read_mask,
    read_over_black,
    say_unmarked,
    source_mask,
    typed,
    write_marked,
)
from attnwarp.command.page import EarlyPage, show_edit
from attnwarp.command.page.turntable import check_film
from attnwarp.command.preview import Preview
from attnwarp.devices import choose, device_of, peak_memory, type_of
from attnwarp.editing.memory import announced
from attnwarp.editing.segment import Mask, check_marks, segmenter_folders
from attnwarp.editing.small import bundled, dtype_of, load_editor
from attnwarp.errors import InputError, InputWarning, suggest
from attnwarp.fit import (
    FitSettings,
    Views,
    beside_mean_color,
    compile_kernels,
    first_splats,
    fit,
    load_views,
    say_unlike,
    say_without_surface,
    without_surface,
)
from attnwarp.fit.views import shrunk_to
from attnwarp.gaussians import Gaussians
from attnwarp.io import THIRD_SCALE, Dataset, write_ply
from attnwarp.io.names import file_stems
from attnwarp.methods import METHODS, MethodSettings, Result
from attnwarp.methods.algorithms.attention_warping import check_editor
from attnwarp.methods.attention_settings import AttentionWarpingSettings
from attnwarp.methods.base import VIEWER_PLY, workdir_of
from attnwarp.methods.by_warps import SourceSettings
from attnwarp.methods.change import say_drift, say_little
from attnwarp.methods.features import Features
from attnwarp.methods.pictures import Segment, check_view_aspect
from attnwarp.methods.scene import checked_segments
from attnwarp.methods.tuning import perceptual_net
from attnwarp.methods.work import Work
from attnwarp.process import asked_to_stop, core_count
from attnwarp.reporting import Reporter
from attnwarp.warp import piece_around
from attnwarp.workdir import FORMAT, Budget

FIT_FOLDER = "fit"

NO_FEATURES = 0.001
"""Share of warped target pixels below which each view was effectively edited alone."""

MOST_NAMES = 5
"""Largest number of view names in one line."""


@dataclass(frozen=True)
class FitPlan:
    """Settings of the fit before an edit. ``reports/editing/time.md`` has the defaults' duration,
    and the gain from half and twice as much time."""

    iterations: int = 3_000
    kind: str = "2d"
    max_splats: int = 30_000


@dataclass(frozen=True)
class EditOptions:
    """Options of an edit by any method.

    Args:
        source: name or number of the marked source view; None takes the first view, of the split
            "train" if the dataset has one.
        max_size: longest side in px; larger pictures are averaged down to it.
        device: device of the editor and the splats, "auto", "cpu" or "cuda".
        dtype: dtype of the editor; see :func:`attnwarp.devices.type_of`.
        control: True also edits each of the page's views alone; None does so with a bundled editor.
    """

    marks: Marks
    tune_outside: bool
    source: str | None
    max_size: int | None
    device: str
    dtype: str
    low_memory: bool
    threads: int | None
    control: bool | None
    turntable: Path | None


def edit_dataset(
    method: str,
    dataset: Dataset,
    splats: Gaussians | None,
    editor_name: str,
    instruction: str,
    settings: MethodSettings,
    out: Path,
    options: EditOptions,
    *,
    fit_plan: FitPlan | None = None,
    source_picture: Path | None = None,
    notes: Callable[[], Sequence[str]] = tuple,
    origin: str = "",
    exposures: Mapping[str, npt.NDArray[np.float64]] = MappingProxyType({}),
    preview: Preview | None = None,
    report: Reporter,
    **own: Any,
) -> tuple[Result | list[str], Path]:
    """Fit splats if none are given, edit them, and write the page.

    Args:
        method: key of :data:`attnwarp.methods.METHODS`.
        splats: the scene before the edit; None fits it first.
        editor_name: name or path, see :func:`attnwarp.editing.small.load_editor`.
        source_picture: file of the source view edited elsewhere, for attention warping.
        notes: gives the warnings of the command so far, for the page.
        origin: sentence on the origin of the inputs, for the page.
        exposures: (3, 4) change of colour of views, by their names; see
            :func:`attnwarp.fit.read_exposures`.
        preview: answers that are shown, or one of which attention warping goes on from.
        own: additional options of the method, such as "budget".

    Returns:
        Result of the edit, or a line on each answer of a preview, and the path of the page.

    Raises:
        InputError: an unknown view, mask, editor or segmenter; marks that select nothing; foreign
            files in the results' folder; an unsupported film format.
    """
    index = view_of(dataset, options.source)
    device = choose(options.device, report)
    editor = _editor(editor_name, device, options, report)
    editor.check_text(instruction)
    if settings.size is None:
        settings = settings.changed(size=editor.own_size)
    max_size = options.max_size
    if splats is None:
        max_size = shrunk_to(max_size, dataset.with_pictures().cameras, device, report)
    views = load_views(dataset, max_size=max_size, exposures=exposures)
    if exposures:
        known = sum(change is not None for change in views.exposures)
        report.log(f"{known} of {len(views)} views have the exposure that the fit estimated")
    warping = isinstance(settings, AttentionWarpingSettings)
    if warping:
        by_hand = _by_hand(source_picture, dataset, views, index)
        own = {"source": index, "source_picture": by_hand, **own}
    elif isinstance(settings, SourceSettings):
        own = {"source": index, **own}
    segments = marked(options.marks, editor_name, dataset, views, index, out, device, report)
    if splats is None:
        assert fit_plan is not None
        # Refuse settings that the editor or the tuning cannot use before the fit.
        if isinstance(settings, AttentionWarpingSettings):
            check_editor(editor, settings)
            Features(editor, settings, "cpu")
        perceptual_net(settings)
        splats = _fitted(dataset, views, fit_plan, settings.seed, out / FIT_FOLDER, device, report)
    torch.set_num_threads(options.threads or core_count())
    splats = splats.to(device=device)
    line = ""
    if preview is None or preview.answer is not None:
        compile_kernels(splats.kind, report, device)
        if line := say_without_surface(without_surface(splats, views)):
            report.log(line)
    elif options.marks.of_source or editor.guide == "depth":
        compile_kernels(splats.kind, report, device)
    lifted, early = segments(splats), EarlyPage(workdir_of(out), views)
    written = early.write
    if preview is not None:
        work = Work(
            splats, views, editor, instruction, settings, "auto", preview.folder, report,
            checked_segments(lifted, views),
        )  # fmt: skip
        about = {"method": method, "instruction": instruction, "options": own["asked"]}
        if preview.answer is None:
            return preview.make(work, index, about)
        preview.claim(work, index, about)
        settings = settings.changed(seed=preview.answer)
        own["recorded"], going_on = preview.recorded(), preview

        def written() -> None:
            going_on.check_source(file_stems(views.cameras)[index])
            early.write()

    result = METHODS[method](
        splats,
        views.cameras,
        views.images,
        editor,
        instruction,
        settings,
        segments=lifted,
        masks=views.masks,
        exposures=views.exposures,
        tune_outside=options.tune_outside,
        folder=out,
        written=written,
        report=report,
        **own,
    )
    if preview is not None:
        preview.drop_features()
    if peak := peak_memory(device):
        report.log(f"edited{peak}")
    if result.gaussians.kind == "2d":
        # Other programs cannot read splats of two scales.
        write_ply(out / VIEWER_PLY, result.gaussians, third_scale=THIRD_SCALE)
    for text in advice(result, settings, out):
        warnings.warn(text, InputWarning, stacklevel=1)
    # A bundled editor takes seconds, so it also edits the views alone.
    control = editor_name in bundled() if options.control is None else options.control
    page = show_edit(
        workdir_of(out), splats, views, turntable=options.turntable, report=report,
        editor=editor if control else None, notes=[line, *notes()], origin=origin,
    )  # fmt: skip
    return result, page


def advice(result: Result, settings: MethodSettings, out: Path) -> list[str]:
    """List what is wrong with a finished edit, and what to do about it."""
    moved, warns = say_drift(result.drift)
    texts = [say_little(result.change) or "", moved if warns else ""]
    carries = getattr(settings, "a0", 0) > 0 and len(result.edited) > 1
    if carries and result.counters["injected"] < NO_FEATURES:
        texts.append(
            "each view was edited alone, as none got features of the source: perhaps the splats do"
            " not fit the photographs, or no other view sees what --source sees, or masks leave"
            f" nothing; {out / 'masks'} shows where features went"
        )
    return [text for text in texts if text]


def _by_hand(
    source_picture: Path | None, dataset: Dataset, views: Views, index: int
) -> npt.NDArray[np.float32] | None:
    """Read the edit of the source view made elsewhere, (h, w, 3), if given."""
    if source_picture is None:
        return None
    pictures = dataset.with_pictures().image_paths
    pixels, top = read_over_black(source_picture, beside=pictures[index])
    by_hand = (pixels / top).astype(np.float32)
    h, w, _ = by_hand.shape
    # The edit checks again; here the check precedes loading an editor and minutes of fitting.
    check_view_aspect((h, w), views.cameras[index], f"--source-picture: {source_picture}")
    return by_hand


def _editor(name: str, device: str, options: EditOptions, report: Reporter) -> Any:
    """Load the editor; before, report its memory."""
    dtype = dtype_of(options.dtype, device, name)
    if line := announced(name, dtype, device):
        report.log(line)
    return load_editor(name, device=device, dtype=dtype, low_memory=options.low_memory)


def marked(
    marks: Marks,
    editor_name: str,
    dataset: Dataset,
    views: Views,
    index: int,
    out: Path,
    device: str,
    report: Reporter,
) -> Callable[[Gaussians], list[Segment] | None]:
    """Read the marks now and return a function from splats to the segments of all views."""
    pictured = dataset.with_pictures()
    pictures = pictured.image_paths
    if marks.masks is not None:
        given = _masks(marks.masks, views.cameras, pictures, report)
        return lambda splats: given
    if not marks.of_source:
        if editor_name in bundled():
            say_unmarked(editor_name, report)
        return lambda splats: None
    camera, full = views.cameras[index], pictured.cameras[index]
    size = full.width, full.height
    check_marks(*size, box=marks.box, at=marks.at)

    def of_source(pieces: Sequence[Mask] = ()) -> Mask:
        picture = views.picture(index)
        mask = source_mask(
            marks, camera, picture, pictures[index], size, out, device, report, pieces
        )
        kept = views.masks[index]
        if kept is not None and not (mask & kept).any():
            raise InputError(
                f"{marks.option}: marks only what the capture's mask of {camera.name} ignores, and"
                " the scene lacks; mark another part, or leave the masks out by --ignore-key"
                " mask_path"
            )
        return mask

    early = None if marks.at is not None else of_source()
    if early is None:
        everything = np.ones((camera.height, camera.width), bool)
        write_marked(marks, views.picture(index), everything, size, out)
        report.log(f"--at {typed(marks, size)} is drawn in {out / MARKED}")

    def segments(splats: Gaussians) -> list[Segment]:
        # Shrunk sides are rounded, so a click on the border could leave the picture.
        sides = camera.width, camera.height
        at = [
            [min(side / full * v, side) for v, side, full in zip(point, sides, size, strict=True)]
            for point in pairs(marks.at)
        ]
        pieces = [piece_around(splats, camera, point) for point in at]
        mask = of_source(pieces) if early is None else early
        lifted = lifted_segments(mask, splats, views, index, report)
        if not any((segment > 0.5).any() for segment in lifted):
            raise InputError(
                f"{marks.option}: lifted through the splats, what it marks covers no pixel of any"
                f" view; mark more, by {HOW}, or all views by --masks"
            )
        return lifted

    return segments


def _fitted(
    dataset: Dataset,
    views: Views,
    plan: FitPlan,
    seed: int,
    folder: Path,
    device: str,
    report: Reporter,
) -> Gaussians:
    """Fit splats to all views, resuming a fit in the folder."""
    settings = FitSettings.from_dict(
        {
            "kind": plan.kind,
            "iterations": plan.iterations,
            "max_splats": plan.max_splats,
            "seed": seed,
        }
    )
    start = first_splats(dataset, views.cameras, settings, report, views=views).to(device=device)
    report.log(f"no --ply: fitting splats to {len(views)} views first: {folder}")
    folder.mkdir(parents=True, exist_ok=True)
    with asked_to_stop(report) as stop:
        result = fit(start, views, settings, folder=folder, report=report, stop=stop)
    if result.stopped == "asked":
        raise KeyboardInterrupt
    if line := say_unlike(*beside_mean_color(result.gaussians, views)):
        warnings.warn(line, InputWarning, stacklevel=2)
    return result.gaussians


def check_asked(
    method: str,
    instruction: str,
    settings: MethodSettings,
    budget: Budget,
    out: Path,
    options: EditOptions,
    asked: dict[str, Any],
    preview: Preview | None = None,
) -> None:
    """Refuse invalid arguments before a capture is rendered or read.

    Args:
        asked: further options that decide the result, by name, as typed.
        preview: see :func:`edit_dataset`.
    """
    check_film(options.turntable)
    type_of(options.dtype, "cpu" if options.device == "auto" else str(device_of(options.device)))
    if options.marks.words is not None:
        segmenter_folders(options.marks.segmenter)
    known = settings.to_dict()
    if settings.size is None:  # the editor's default, known once the editor is loaded
        del known["size"]
    manifest = {
        "format": FORMAT, "method": method, "instruction": instruction, "settings": known,
        "options": asked,
    }  # fmt: skip
    if preview is not None:
        preview.check(manifest)
        if preview.answer is None:
            return
        known["seed"] = preview.answer
    workdir_of(out).check_claimed({**manifest, "budget": budget.to_dict()})


def check_marked(options: EditOptions, dataset: Dataset) -> None:
    """Refuse an unknown source view, and marks outside its picture."""
    index, marks = view_of(dataset, options.source), options.marks
    camera = dataset.with_pictures().cameras[index]
    check_marks(camera.width, camera.height, box=marks.box, at=marks.at)


def view_of(dataset: Dataset, name: str | None) -> int:
    """Find a view's number by its name among views with a picture; see :func:`number_of`. No name
    means the first training view."""
    if name is None:
        splits = dataset.with_pictures().splits
        return splits.index("train") if "train" in splits else 0
    pairs = zip(dataset.cameras, dataset.image_paths, strict=True)
    left_out = [camera.name for camera, image in pairs if image is None]
    return number_of([camera.name for camera in dataset.with_pictures().cameras], name, left_out)


def number_of(names: Sequence[str], name: str, left_out: Sequence[str] = ()) -> int:
    """Find the number of a view by its name, its file's name (suffix optional), or its number.

    Example:
        >>> number_of(["left/a.png", "left/b.png"], "b"), number_of(["a", "b", "c"], "2")
        (1, 2)
    """
    for candidates in _spellings(names):
        if candidates.count(name) == 1:
            return candidates.index(name)
    if name.isdecimal() and int(name) < len(names):
        return int(name)
    if any(name in candidates for candidates in _spellings(left_out)):
        raise InputError(f"--source: the picture of {name!r} is missing; name another view")
    raise InputError(
        f"--source: got {name!r}, expected a view's name or a number below {len(names)}"
        f"{suggest(name, names)}"
    )


def _spellings(names: Sequence[str]) -> list[list[str]]:
    """List the names, their files' names with suffix, and without."""
    return [[*names], [Path(name).name for name in names], [Path(name).stem for name in names]]


def _masks(
    folder: Path, cameras: Any, pictures: Sequence[Path | None], report: Reporter
) -> list[npt.NDArray[np.bool_]]:
    """Read the mask of each view from NAME.png, (H, W) bool: white is edited."""
    if not folder.is_dir():
        raise InputError(f"--masks: {folder} is no folder; name one with a PNG for each view")
    paths = mask_files(folder, cameras)
    masks = [
        read_mask(path, camera, beside=picture)
        for path, camera, picture in zip(paths, cameras, pictures, strict=True)
    ]
    if not any(mask.any() for mask in masks):
        raise InputError(
            f"--masks: every mask in {folder} is black, so nothing may change; white is edited"
        )
    empty = [camera.name for mask, camera in zip(masks, cameras, strict=True) if not mask.any()]
    if empty:
        more = f" and {len(empty) - MOST_NAMES} more" if len(empty) > MOST_NAMES else ""
        report.log(
            f"--masks: {len(empty)} of {len(masks)} are black, so nothing is edited in"
            f" {', '.join(empty[:MOST_NAMES])}{more}"
        )
    return masks


def mask_files(folder: Path, cameras: Any) -> list[Path]:
    """Find each view's mask file: by the view's name with folders, by its bare name if unique, or
    numbered as an edit writes it."""
    names = [Path(*(p for p in PurePath(c.name).parts if p not in ("..", "/"))) for c in cameras]
    plain = [name.parent / name.stem for name in names]
    counts = Counter(plain)
    paths: list[Path] = []
    for name, short, numbered in zip(names, plain, file_stems(cameras), strict=True):
        own = [f"{name}.png", *([f"{short}.png"] if counts[short] == 1 else ()), f"{numbered}.png"]
        path = next((folder / file for file in own if (folder / file).is_file()), None)
        if path is None:
            raise InputError(
                f"--masks: {folder / own[-1]} is missing; expected one PNG for each view"
            )
        paths.append(path)
    return paths
