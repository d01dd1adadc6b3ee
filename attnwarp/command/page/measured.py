"""Figures and pictures on an edit's page: its control, agreement, and spill."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from itertools import permutations
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.camera import Camera
from attnwarp.editing.editor import Editor
from attnwarp.fit import Views
from attnwarp.gaussians import Gaussians
from attnwarp.io import read_ply
from attnwarp.io.names import file_stems
from attnwarp.methods.algorithms.attention_warping import AttentionWarping, RecordedSource
from attnwarp.methods.algorithms.by_view import ByView, ByViewSettings
from attnwarp.methods.base import Edit, edit_file
from attnwarp.methods.pictures import Bytes, Segment, to_bytes
from attnwarp.methods.scene import near_of
from attnwarp.methods.settings import PRESETS
from attnwarp.methods.tuning import Order
from attnwarp.methods.work import Work
from attnwarp.reporting import Reporter
from attnwarp.warp import preset, render_surface, sample_at, warp_surfaces
from attnwarp.workdir import MANIFEST, Workdir

CONTROL = "control"
"""Folder of the views edited alone."""


NOTHING_CARRIED = {"a0": 0.0, "unseen": "free", "reference": "none"}
"""Settings of attention warping with which a view's edit takes nothing from another view's. Other
methods' controls are :func:`attnwarp.methods.by_view`'s edits.
"""

CONTROLLED = ("attention_warping", "corresponding", "fused", "warped_reference")
"""Methods whose views have a control. Others begin at renders or draw keys, and edit no view alone
with all else equal."""


def edited_alone(
    folder: Workdir,
    gaussians: Gaussians,
    scene: Views,
    segments: list[Segment] | None,
    editor: Editor,
    views: Sequence[int],
    report: Reporter,
) -> None:
    """Edit each view alone into a run's folder, with all else as in the view's last edit: its
    noise, start, steps, guidance and splats.

    Args:
        views: numbers of the views; views already in the folder are kept.
    """
    manifest, names = folder.read_json(MANIFEST), file_stems(scene.cameras)
    if (name := manifest["method"]) not in CONTROLLED:
        return
    (folder.path / CONTROL).mkdir(parents=True, exist_ok=True)
    files = {view: f"{CONTROL}/{names[view]}.png" for view in views}
    source = manifest.get("source")
    shown = {names[view]: view for view in views}
    if source in shown and name in ("attention_warping", "warped_reference"):
        # It takes nothing from another view, and may have been made elsewhere.
        picture = folder.read_picture(f"views/{source}.png")
        folder.write_picture(files[shown[source]], picture)
    left = [view for view in views if not folder.has(files[view])]
    if not left:
        return
    given, kind = manifest["settings"], type(next(iter(PRESETS[name].values())))
    carrying = NOTHING_CARRIED if name == "attention_warping" else {}
    settings: Any = kind.from_dict({**given, **carrying})
    work = Work(
        gaussians, scene, editor, manifest["instruction"], settings, "auto", folder, report,
        segments,
    )  # fmt: skip
    method: Any
    if name == "attention_warping":
        method = AttentionWarping(work, settings, names.index(source), None, None, "cpu")
        edited = folder.read_picture(f"views/{source}.png").astype(np.float32) / np.float32(255)
        method.keep(RecordedSource(edited, None))
    else:
        shared = {field.name for field in fields(ByViewSettings)} & given.keys()
        method = ByView(work, ByViewSettings.from_dict({name: given[name] for name in shared}))
    loop = _Control(work, files, left)
    if isinstance(method, ByView):
        loop.last = dict.fromkeys(left, 0)
    method.run(loop)


class _Control:
    """Loop that writes the last edit of some views, without tuning.

    Args:
        files: path in the run's folder of each view's edit.
    """

    def __init__(self, work: Work, files: Mapping[int, str], left: Sequence[int]) -> None:
        self.work, self.files, self.left = work, files, left
        names, has = file_stems(work.views.cameras), work.folder.has
        rounds = range(len(work.folder.read_json(MANIFEST)["rounds"]))
        self.last = {
            view: max((k for k in rounds if has(edit_file(k, names[view]))), default=0)
            for view in left
        }

    def edit(self, number: int, views: Sequence[int], edit: Edit, *, rows: int) -> None:
        """Edit views together, if this is the last edit of some that are left."""
        wanted = {view for view in views if self.last.get(view) == number}
        if not wanted or all(self.work.folder.has(self.files[view]) for view in wanted):
            return
        done = sum(self.work.folder.has(self.files[view]) for view in self.left)
        self.work.report.step(done, len(self.left), "control: each view of the page edited alone")
        model, tuned = self.work.frozen, self.work.folder.path / f"rounds/{number}.ply"
        if number and tuned.is_file():
            model = read_ply(tuned)
        for view, one in zip(views, edit(model, lambda: None), strict=True):
            if view in wanted:
                picture = self.work.composite(view, one.picture)
                self.work.folder.write_picture(self.files[view], to_bytes(picture))

    def tune(
        self, number: int, views: Sequence[int], iterations: int, order: Order | None = None
    ) -> None:
        """Leave the splats as they are."""


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
