"""Attention warping: carry the edit of one view into the other views, then tune the splats.

:meth:`AttentionWarping.run` is Algorithm 1 of "Diffusion-Based Attention Warping for Consistent 3D
Scene Editing"; numbers in comments are line numbers of Algorithm 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from itertools import chain, groupby
from typing import Any, Literal, Unpack

import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.editing import injection
from attnwarp.editing.editor import Editor
from attnwarp.editing.injection import TokenWarp
from attnwarp.editing.recording import record
from attnwarp.gaussians import Gaussians
from attnwarp.methods.attention_settings import PRESETS, AttentionWarpingSettings
from attnwarp.methods.base import Loop, Method, Options, Result, ViewEdit, run
from attnwarp.methods.doors import register
from attnwarp.methods.geometry import Warps
from attnwarp.methods.stages import draw_stages, released_order
from attnwarp.methods.view_edits import RecordedSource, ViewEdits
from attnwarp.methods.work import Work, chunks

CORRECTED = AttentionWarpingSettings()
"""Settings used when the caller passes none."""


def attention_warping(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    images: Sequence[npt.NDArray[Any]] | None,
    editor: Editor,
    instruction: str,
    settings: AttentionWarpingSettings | None = None,
    *,
    source: int = 0,
    source_picture: npt.NDArray[Any] | None = None,
    warps: Warps | None = None,
    store: Literal["device", "cpu", "disk"] = "cpu",
    **options: Unpack[Options],
) -> Result:
    """Edit one view of a scene, carry the edit into other views, and tune the splats on all views.

    Args:
        gaussians, cameras, images, editor, instruction, options: see :func:`by_view`.
        settings: every choice of the method; ``corrected`` if left out.
        source: number of the source view.
        source_picture: (h, w, 3) edit of the source view made elsewhere, such as by hand. Its type
            is any that ``images`` accepts, and its aspect ratio is the view's. Its features are
            recorded while its inverted noise is replayed (edit-friendly inversion).
        warps: function of a source's and a target's number that returns their warp, such as one
            from exact depth; replaces the warps from the splats' depth.
        store: place of the recorded features until the edit ends: the editor's "device", main
            memory ("cpu"), or the folder ("disk").

    Raises:
        ValueError, InputError, RuntimeError: see :func:`by_view`.

    Example:
        >>> from attnwarp.editing.small import load_editor
        >>> from attnwarp.methods import attention_warping, preset
        >>> from attnwarp.trial import disc, view
        >>> quick = preset("attention_warping", stages=1, steps=1, iterations=1)
        >>> editor = load_editor("small-plain")
        >>> result = attention_warping(disc(), [view(0), view(1)], None, editor, "red", quick)
        >>> result.rounds[0].views, result.edited[1].shape  # the source, then the target
        ((0, 1), (32, 32, 3))
    """
    check.one_of(store, ("device", "cpu", "disk"), "store")
    make = partial(
        AttentionWarping, source=source, by_hand=source_picture, warps=warps, store=store
    )
    return run(
        "attention_warping", make, AttentionWarpingSettings,
        gaussians, cameras, images, editor, instruction, settings, **options,
    )  # fmt: skip


def a_t(t: int, T: int, s: AttentionWarpingSettings = CORRECTED) -> float:
    """Weight of the source's features at step t of T: a_t = a0 (T - t) / T, or as ``decay`` says.

    Example:
        >>> [round(a_t(t, 4), 3) for t in range(4)]
        [0.9, 0.675, 0.45, 0.225]
        >>> late = AttentionWarpingSettings(a0=1.0, decay="late")
        >>> [a_t(t, 6, late) for t in range(6)]
        [1.0, 1.0, 1.0, 1.0, 1.0, 0.5]
        >>> import numpy as np
        >>> from attnwarp.editing.editor import edit
        >>> from attnwarp.editing.recording import RecordingPlan, record
        >>> from attnwarp.editing.small import load_editor
        >>> editor, picture = load_editor("small-plain"), np.full((32, 32, 3), 0.5, np.float32)
        >>> plan = RecordingPlan(editor.layers(), (8, 8), editor.branches, steps=1)
        >>> with record(editor, plan) as recording:
        ...     source = edit(editor, [picture], "make it red", steps=1)
        >>> with inject(editor, recording, weight=lambda t, T: 1.0):
        ...     again = edit(editor, [picture], "make it red", steps=1)
        >>> bool((again.images[0] == source.images[0]).all())  # its own features change no bit
        True
    """
    falling = s.a0 * (T - t) / T
    return {"linear": falling, "late": min(s.a0, 3 * falling), "constant": s.a0}[s.decay]


def blend(warp: TokenWarp, F_src: Tensor, F_new: Tensor, a: float) -> Tensor:
    """F_final = a F_masked + (1 - a) F_new, with F_masked = M F_warp + (1 - M) F_new.

    Args:
        warp: M and F_warp of the layer, such as :class:`attnwarp.warp.FeatureWarp`.
        F_src: (1, h w, C) recorded features of the source.
        F_new: (1, H W, C) features of the target.
        a: a_t, in [0, 1].

    Example:
        >>> import torch
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import warp_surfaces
        >>> source, target, seen = wall()  # 2 px apart
        >>> layer = warp_surfaces(source, target, seen, seen).at((4, 4))
        >>> column = torch.arange(4.0).repeat(4).reshape(1, 16, 1)
        >>> blend(layer, column, torch.zeros(1, 16, 1), 0.5)[0, :4, 0].tolist()
        [0.5, 1.0, 1.5, 0.0]
    """
    F_warp, aM = warp.warp_tokens(F_src), a * warp.weight.to(F_new)
    return torch.lerp(F_new, F_warp, aM)  # aM F_warp + (1 - aM) F_new


inject = partial(injection.inject, weight=a_t, blend=blend)
"""Injection of Algorithm 1: :func:`attnwarp.editing.injection.inject` with its weight and blend."""


class AttentionWarping(Method):
    """Algorithm 1, as configured by the settings."""

    def __init__(
        self,
        work: Work,
        settings: AttentionWarpingSettings,
        source: int,
        by_hand: npt.NDArray[Any] | None,
        warps: Warps | None,
        store: str,
    ) -> None:
        self.work, self.settings = work, settings
        self.views = ViewEdits(work, settings, source, by_hand, warps, store, self.edit_source)
        self.source = source
        unedited = [view for view in range(len(work.sizes)) if view != source]
        self.stages = draw_stages(unedited, settings)
        self.views.check_stages(len(self.stages) if unedited else 0)
        self.about, self.inputs = self.views.about, self.views.inputs
        if warps is not None:
            self.inputs["warps"] = self.views.geometry.digest([source], [*chain(*self.stages)])
        self.notes = self.views.notes(len(self.stages))
        if settings.psnr_views == "before_last_stage" and len(self.stages) > 1:
            self.psnr_leaves_out = self.stages[-1]

    def run(self, loop: Loop) -> None:
        """Run Algorithm 1."""
        s, edited = self.settings, [self.source]
        # (1) Edit the source and record its features.
        loop.edit(0, (self.source,), self.edit_source, rows=self.views.rows_of_source())
        # (2) For each stage:
        for stage, views in enumerate(self.stages):
            # (3) choose views at random among the unedited ones (see draw_stages);
            for _, same in groupby(views, key=lambda view: self.work.sizes[view]):
                for batch in chunks(list(same), s.batch):
                    # (4) warp the source's features to these views, (5) edit with them injected;
                    rows = self.views.rows(len(batch), s.guidance(stage), stage)
                    loop.edit(stage, batch, partial(self.edit_targets, stage, batch), rows=rows)
            # (6) tune the splats on the edited views.
            edited += [view for view in views if view not in edited]
            if s.training == "all" or not views:
                loop.tune(stage, edited, s.iterations)
            elif s.training == "stage":
                loop.tune(stage, views, s.iterations)
            else:  # "modulo"
                loop.tune(stage, [self.source, *views], s.iterations, released_order(len(views)))

    def edit_source(self, model: Gaussians, step: Callable[[], None]) -> list[ViewEdit]:
        """Edit the source and record its features meanwhile (line 1)."""
        work, views, view = self.work, self.views, self.source
        with (
            work.folder.seconds.part("source"),
            work.guided(views.features.source_guidance),
            ExitStack() as stack,
        ):
            start = views.start([view], work.frozen, by_hand=True)
            tokens, recording = views.keeping(stack), None
            if views.features.layers:
                plan = views.features.plan(views.latent_size(view))
                recording = stack.enter_context(record(work.editor, plan))
            (picture,) = views.denoise(start, [None], step)
        views.keep(RecordedSource(picture, recording, tokens))
        return [views.result(view, picture)]

    def edit_targets(
        self, stage: int, batch: Sequence[int], model: Gaussians, step: Callable[[], None]
    ) -> list[ViewEdit]:
        """Warp the source's features to views of one size and edit the views (lines 4 and 5)."""
        work, views, s = self.work, self.views, self.settings
        source = views.recorded
        with work.folder.seconds.part("warp"):
            warps = [views.warp(view, model) for view in batch]
        with work.guided(s.guidance(stage)), ExitStack() as stack:
            start = views.referenced(views.start(batch, model, stage=stage), warps)
            views.attend(stack, batch, warps)
            if source.recording is not None:
                layers = [views.of_features(warp) for warp in warps]
                weight = partial(a_t, s=s)
                stack.enter_context(
                    inject(work.editor, source.recording, warps=layers, weight=weight)
                )
            pictures = views.denoise(start, warps, step)
        return [
            views.result(view, picture, warp)
            for view, picture, warp in zip(batch, pictures, warps, strict=True)
        ]

    def clear(self) -> None:
        """Remove recordings on disk."""
        self.views.clear()

    def counters(self, records: dict[int, dict[str, Any]]) -> dict[str, float]:
        """Count bytes of features; average the warps' weights, before a_t."""
        shares = [about["injected"] for view, about in records.items() if view != self.source]
        return {
            "feature_bytes": sum(about.get("feature_bytes", 0) for about in records.values()),
            "injected": sum(shares) / len(shares) if shares else 0.0,
        }


register("attention_warping", attention_warping, PRESETS)
