"""Figures and pictures on an edit's page: its control, agreement, and spill."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from itertools import groupby, permutations
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.camera import Camera
from attnwarp.editing.editor import Editor
from attnwarp.fit import Views
from attnwarp.gaussians import Gaussians
from attnwarp.io.names import file_stems
from attnwarp.methods.attention_warping import AttentionWarping
from attnwarp.methods.base import ViewEdit
from attnwarp.methods.by_view import ByView
from attnwarp.methods.pictures import Bytes, Segment, to_bytes
from attnwarp.methods.scene import near_of
from attnwarp.methods.settings import (
    AttentionWarpingSettings,
    ByViewSettings,
    MethodSettings,
)
from attnwarp.methods.work import Work, chunks
from attnwarp.reporting import Reporter
from attnwarp.warp import preset, render_surface, sample_at, warp_surfaces
from attnwarp.workdir import MANIFEST, Workdir

CONTROL = "control"
"""Folder of the views edited alone."""


def edited_alone(
    folder: Workdir,
    gaussians: Gaussians,
    scene: Views,
    segments: list[Segment] | None,
    editor: Editor,
    views: Sequence[int],
    report: Reporter,
) -> None:
    """Edit each view alone, with the run's noise and all else equal, into a run's folder.

    Args:
        views: numbers of the views; views already in the folder are kept.
    """
    manifest, names = folder.read_json(MANIFEST), file_stems(scene.cameras)
    (folder.path / CONTROL).mkdir(parents=True, exist_ok=True)
    files = {view: f"{CONTROL}/{names[view]}.png" for view in views}
    left = [view for view in views if not folder.has(files[view])]
    if not left:
        return

    def work_with(settings: MethodSettings) -> Work:
        instruction = manifest["instruction"]
        return Work(
            gaussians, scene, editor, instruction, settings, "auto", folder, report, segments
        )

    edits: list[tuple[Sequence[int], Callable[..., list[ViewEdit]]]] = []
    given = manifest["settings"]
    if manifest["method"] == "attention_warping":
        nothing = {"a0": 0.0, "unseen": "free", "reference": "none"}
        settings = AttentionWarpingSettings.from_dict({**given, **nothing})
        work, source = work_with(settings), names.index(manifest["source"])
        method = AttentionWarping(work, settings, source, None, None, "cpu")
        edits.append(((source,), method.edit_source))
        targets = [view for view in left if view != source]
        for _, same in groupby(targets, key=lambda view: work.sizes[view]):
            for some in chunks([*same], settings.batch):
                edits.append((some, partial(method.edit_targets, 0, some)))
    else:
        shared = {field.name for field in fields(ByViewSettings)} & given.keys()
        alone = ByViewSettings.from_dict({name: given[name] for name in shared})
        work = work_with(alone)
        by_view = ByView(work, alone)
        edits += [(batch, partial(by_view.edit, batch)) for batch in by_view.batches(left)]
    for number, (batch, edit) in enumerate(edits):
        report.step(number, len(edits), "control: each view of the page edited alone")
        for view, one in zip(batch, edit(work.frozen, lambda: None), strict=True):
            if view in left:
                folder.write_picture(files[view], to_bytes(work.composite(view, one.picture)))


def disagreement(
    gaussians: Gaussians,
    cameras: Mapping[int, Camera],
    pictures: Mapping[str, Mapping[int, Bytes]],
    segments: Mapping[int, npt.NDArray[np.bool_]] | None = None,
    kept: Mapping[int, npt.NDArray[np.bool_]] = MappingProxyType({}),
) -> dict[str, float]:
    """Average the difference between pictures of one surface point over all ordered pairs of views,
    at correspondences of rendered splats accepted by the preset ``corrected``.

    Args:
        cameras: cameras of the views, at the size of their pictures.
        pictures: (H, W, 3) uint8 of each view, by kind of picture.
        segments: (H, W) bool of each view: the pixels that count.
        kept: (H, W) bool of views with a mask: False where the picture is to be ignored.

    Returns:
        Mean absolute difference as a share of the full range, by kind of picture; a kind without
        two views of one point has no entry.
    """
    near = near_of(list(cameras.values()), gaussians)
    settings = preset("corrected")
    surfaces = {
        view: render_surface(gaussians, camera, settings, near=near)
        for view, camera in cameras.items()
    }
    totals, counts = dict.fromkeys(pictures, 0.0), dict.fromkeys(pictures, 0)
    for source, target in permutations(cameras, 2):
        warp = warp_surfaces(
            cameras[source], cameras[target], surfaces[target], surfaces[source], settings,
            warn_empty=False,
        )  # fmt: skip
        counted = warp.mask.numpy()
        if segments is not None:
            counted = counted & segments[target]
        if target in kept:
            counted = counted & kept[target]
        if source in kept:
            share = sample_at(torch.from_numpy(kept[source])[None].double(), warp.correspondence.xy)
            counted = counted & (share[0] > 0.5).numpy()
        for name, of_view in pictures.items():
            if not {source, target} <= of_view.keys():
                continue
            channels = torch.from_numpy(of_view[source]).double().permute(2, 0, 1)
            there = sample_at(channels, warp.correspondence.xy).permute(1, 2, 0).numpy()[counted]
            here = of_view[target][counted].astype(np.float64)
            totals[name] += float(np.abs(there - here).sum()) / (3 * 255)
            counts[name] += len(here)
    return {name: totals[name] / counts[name] for name in pictures if counts[name]}


def spill(
    before: Sequence[npt.NDArray[Any]],
    after: Sequence[npt.NDArray[Any]],
    segments: Sequence[npt.NDArray[np.bool_]],
) -> tuple[float, float]:
    """Measure the share of a change that lies outside the segments.

    Args:
        before, after: (H, W, 3) pictures of each view.
        segments: (H, W) bool of each view: the pixels that may change.

    Returns:
        The share of the summed absolute change outside (NaN for no change), and the segments' share
        of the pixels.

    Example:
        >>> import numpy as np
        >>> left = np.array([[True, False, False, False]])
        >>> change = np.array([[3, 1, 0, 0]], np.uint8)[..., None].repeat(3, axis=2)
        >>> spill([0 * change], [change], [left])
        (0.25, 0.25)
    """
    outside = whole = 0.0
    for one, two, segment in zip(before, after, segments, strict=True):
        change = np.abs(two.astype(np.float64) - one).sum(axis=2)
        outside += float(change[~segment].sum())
        whole += float(change.sum())
    covered = sum(int(segment.sum()) for segment in segments)
    return outside / whole if whole else np.nan, covered / sum(s.size for s in segments)
