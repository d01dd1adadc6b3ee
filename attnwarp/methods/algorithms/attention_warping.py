"""Attention warping: carry the edit of one view into the other views, then tune the splats.

:meth:`AttentionWarping.run` is Algorithm 1 of "Diffusion-Based Attention Warping for Consistent 3D
Scene Editing"; numbers in comments are line numbers of Algorithm 1.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, groupby
from numbers import Integral
from typing import Any, Literal, Self, Unpack

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.digest import digest
from attnwarp.editing import injection
from attnwarp.editing.editor import Editor, edit
from attnwarp.editing.injection import TokenWarp
from attnwarp.editing.inversion import NoiseMaps, inversion_rows, invert_view, noise_maps, replay
from attnwarp.editing.lanes import editors_for, parts_for, side_by_side
from attnwarp.editing.layers import Kind, Layer
from attnwarp.editing.recording import Recording, RecordingPlan, record
from attnwarp.editing.schedule import Size, Time
from attnwarp.fit.views import to_float
from attnwarp.gaussians import Gaussians
from attnwarp.io.names import file_stems
from attnwarp.methods.attention_settings import PRESETS, AttentionWarpingSettings
from attnwarp.methods.base import Loop, Method, Options, Result, ViewEdit, edit_file, run
from attnwarp.methods.carried import carry, initial_noise
from attnwarp.methods.doors import register
from attnwarp.methods.features import Features
from attnwarp.methods.geometry import Geometry, Warps
from attnwarp.methods.padding import ZeroPadded
from attnwarp.methods.pictures import (
    Image,
    check_view_aspect,
    mask_picture,
    resized,
    to_bytes,
)
from attnwarp.methods.scene import checked_image
from attnwarp.methods.stages import draw_stages, released_order
from attnwarp.methods.unseen import (
    SourceTokens,
    attending,
    has_self_attention,
    kept_tokens,
    unseen_of,
)
from attnwarp.methods.work import Guide, Work, chunks
from attnwarp.warp import WarpedView

RECORDING = ".recording"
"""Folder of the recorded features while an edit with ``store="disk"`` is in progress."""


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
    recorded: Mapping[str, Any] | None = None,
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
        recorded: the source's edit and features, made before with equal arguments, as
            :meth:`RecordedSource.state` returns them; the source is then not edited again.

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
        AttentionWarping, source=source, by_hand=source_picture, warps=warps, store=store,
        made=recorded,
    )  # fmt: skip
    return run(
        "attention_warping", make, AttentionWarpingSettings,
        gaussians, cameras, images, editor, instruction, settings, **options,
    )  # fmt: skip


def a_t(t: int, T: int, s: AttentionWarpingSettings = CORRECTED, kind: Kind = "joint") -> float:
    """Weight of the source's features at step t of T: a_t = a0 (T - t) / T, or as ``decay`` says
    for a kind of features.

    Example:
        >>> [round(a_t(t, 4), 3) for t in range(4)]
        [0.9, 0.675, 0.45, 0.225]
        >>> late = AttentionWarpingSettings(a0=1.0, decay="late")
        >>> [a_t(t, 6, late) for t in range(6)]
        [1.0, 1.0, 1.0, 1.0, 1.0, 0.5]
        >>> by_kind = AttentionWarpingSettings(a0=1.0, decay="by_kind")
        >>> [a_t(t, 6, by_kind, "self") for t in range(6)]
        [1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
        >>> [round(a_t(t, 6, by_kind, "cross"), 3) for t in range(6)]
        [1.0, 0.5, 0.0, 0.0, 0.0, 0.0]
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
    late, early = min(s.a0, 3 * falling), max(0.0, s.a0 - 3 * (s.a0 - falling))
    by_kind = {"self": s.a0, "cross": early}.get(kind, late)
    return {"linear": falling, "late": late, "constant": s.a0, "by_kind": by_kind}[s.decay]


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
        made: Mapping[str, Any] | None = None,
    ) -> None:
        self.work, self.settings, self.made = work, settings, made
        self.names = file_stems(work.views.cameras)
        check.instance(source, Integral, "source", "a number of a view")
        if not 0 <= source < len(self.names):
            raise ValueError(
                f"source: got {source}, expected a number of a view below {len(self.names)}"
            )
        self.by_hand = None if by_hand is None else self._checked_by_hand(by_hand, source)
        self.timestep = check_editor(work.editor, settings)
        self.folder = work.folder.path / RECORDING
        self.features = Features(work.editor, settings, self.folder if store == "disk" else store)
        self.geometry = Geometry(
            work, settings.warp, warps, mask=settings.mask, depth_from=settings.depth_from
        )
        self.source = source
        self._recorded: RecordedSource | None = None
        self.about = {"source": self.names[source]}
        self.inputs = {"source_picture": None if self.by_hand is None else digest(self.by_hand)}
        unedited = [view for view in range(len(work.sizes)) if view != source]
        self.stages = draw_stages(unedited, settings)
        self.features.check_batches(
            range(len(self.stages) if unedited else 0), attends=self.attends
        )
        if warps is not None:
            self.inputs["warps"] = self.geometry.digest([source], [*chain(*self.stages)])
        self.notes = self._notes(len(self.stages))
        if settings.psnr_views == "before_last_stage" and len(self.stages) > 1:
            self.psnr_leaves_out = self.stages[-1]

    def run(self, loop: Loop) -> None:
        """Run Algorithm 1."""
        s, edited = self.settings, [self.source]
        # (1) Edit the source and record its features.
        loop.edit(0, (self.source,), self.edit_source, rows=self.rows_of_source())
        # (2) For each stage:
        for stage, views in enumerate(self.stages):
            # (3) choose views at random among the unedited ones (see draw_stages);
            for _, same in groupby(views, key=lambda view: self.work.sizes[view]):
                for batch in chunks(list(same), s.batch):
                    # (4) warp the source's features to these views, (5) edit with them injected;
                    rows = self.rows(len(batch), s.guidance(stage), stage)
                    loop.edit(stage, batch, partial(self.edit_targets, stage, batch), rows=rows)
            # (6) tune the splats on the edited views.
            edited += [view for view in views if view not in edited]
            if s.training in ("all", "lifted") or not views:
                loop.tune(stage, edited, s.iterations)
            elif s.training == "stage":
                loop.tune(stage, views, s.iterations)
            else:  # "modulo"
                loop.tune(stage, [self.source, *views], s.iterations, released_order(len(views)))

    def edit_source(self, model: Gaussians, step: Callable[[], None]) -> list[ViewEdit]:
        """Edit the source and record its features meanwhile (line 1)."""
        work, view = self.work, self.source
        if self.made is not None:
            for _ in range(self.settings.steps):
                step()
            plan = self._plan if self.features.layers else None
            self.keep(RecordedSource.of_state(self.made, plan))
            return [self.result(view, self.recorded.picture)]
        with (
            work.folder.seconds.part("source"),
            work.guided(self.features.source_guidance),
            ExitStack() as stack,
        ):
            start = self.start([view], work.frozen, by_hand=True)
            tokens, recording = self.keeping(stack), None
            if self.features.layers:
                recording = stack.enter_context(record(work.editor, self._plan))
            (picture,) = self.denoise(start, [None], step)
        self.keep(RecordedSource(picture, recording, tokens))
        return [self.result(view, picture)]

    def edit_targets(
        self, stage: int, batch: Sequence[int], model: Gaussians, step: Callable[[], None]
    ) -> list[ViewEdit]:
        """Warp the source's features to views of one size and edit the views (lines 4 and 5)."""
        work, s = self.work, self.settings
        with work.folder.seconds.part("warp"):
            warps = [self.warp(view, model) for view in batch]
        with work.guided(s.guidance(stage)):
            start = self.referenced(self.start(batch, model, stage=stage), warps)
        editors = editors_for(work.editor, len(batch))
        jobs = [
            partial(self._with(editor)._edit_part, stage, start.part(part), warps[part])
            for editor, part in zip(editors, parts_for(len(batch), len(editors)), strict=True)
        ]
        pictures = side_by_side(jobs, step)
        return [
            self.result(view, picture, warp)
            for view, picture, warp in zip(batch, pictures, warps, strict=True)
        ]

    def _with(self, editor: Editor) -> Self:
        """Copy this with another editor, and with the source, which is recorded once."""
        other = copy(self)
        other.work = copy(self.work)
        other.work.editor = editor
        other.keep(self.recorded)
        return other

    def _edit_part(
        self, stage: int, start: Start, warps: Sequence[WarpedView | None], step: Callable[[], None]
    ) -> list[Image]:
        """Edit views of a batch with the source's features."""
        work, s = self.work, self.settings
        recording = self.recorded.recording
        with work.guided(s.guidance(stage)), ExitStack() as stack:
            self.attend(stack, start.views, warps)
            if recording is not None:
                layers = [self.of_features(warp) for warp in warps]
                for kind in {layer.kind for layer in self.features.layers}:
                    same = [layer for layer in self.features.layers if layer.kind == kind]
                    weight = partial(a_t, s=s, kind=kind)
                    stack.enter_context(
                        inject(work.editor, recording, warps=layers, layers=same, weight=weight)
                    )
            return self.denoise(start, warps, step)

    def counters(self, records: dict[int, dict[str, Any]]) -> dict[str, float]:
        """Count bytes of features; average the warps' weights, before a_t."""
        shares = [about["injected"] for view, about in records.items() if view != self.source]
        return {
            "feature_bytes": sum(about.get("feature_bytes", 0) for about in records.values()),
            "injected": sum(shares) / len(shares) if shares else 0.0,
        }

    @property
    def attends(self) -> bool:
        """True if marked tokens that no warp reaches attend to the source."""
        able = has_self_attention(self.work.editor.network) and bool(self._attending_layers)
        return self._wants_attention and able

    @property
    def _wants_attention(self) -> bool:
        marked = self.work.segments is not None
        return self.settings.unseen == "attend" and marked and bool(self.features.layers)

    @property
    def _attending_layers(self) -> tuple[Layer, ...]:
        return tuple(layer for layer in self.features.layers if layer.kind == "self")

    def keeping(self, stack: ExitStack) -> SourceTokens | None:
        """Keep the source's tokens for views to attend to, until the stack is left."""
        if not self.attends:
            return None
        passes = self.settings.feature_range()
        network, layers = self.work.editor.network, self._attending_layers
        return stack.enter_context(kept_tokens(network, layers, self.features.stored, passes))

    @property
    def _plan(self) -> RecordingPlan:
        return self.features.plan(self.latent_size(self.source))

    def _tokens_plan(self, features: RecordingPlan) -> RecordingPlan:
        branches = self.features.branches(self.features.source_guidance)
        return replace(features, layers=self._attending_layers, keep=branches, store="cpu")

    def attend(
        self, stack: ExitStack, views: Sequence[int], warps: Sequence[WarpedView | None]
    ) -> None:
        """Let unseen tokens of views attend to the source, until the stack is left."""
        tokens = self.recorded.tokens
        segments = self.work.segments
        if tokens is None or segments is None:
            return
        unseen = [
            unseen_of(warp, segments[view])
            for view, warp in zip(views, warps, strict=True)
            if warp is not None
        ]
        network, layers = self.work.editor.network, self._attending_layers
        size, passes = self.latent_size(views[0]), self.settings.feature_range()
        stack.enter_context(attending(network, layers, size, tokens, unseen, passes))

    def _checked_by_hand(self, picture: npt.NDArray[Any], source: int) -> Image:
        """Check an edit made elsewhere and resize it to the source's edit."""
        check.shape(np.asarray(picture), ("H", "W", 3), "source_picture")
        image = to_float(checked_image(picture, "source_picture"))
        size = (image.shape[0], image.shape[1])
        check_view_aspect(size, self.work.views.cameras[source], "source_picture")
        if self.settings.latents == "inversion":
            raise ValueError(
                "source_picture: got one with latents 'inversion', but its own noise is replayed;"
                " leave it out, or set latents to 'random'"
            )
        return resized(image, self.work.sizes[source])

    def _notes(self, stages: int) -> list[str]:
        """Describe settings that the views or the editor limit, one line each."""
        asked, views = self.settings, len(self.names)
        longest, lines = max(self.work.sizes[self.source]), []
        if asked.size is not None and longest != asked.size:
            lines.append(
                f"size: {longest} px in place of {asked.size}, as this editor's sides are multiples"
                f" of {self.work.editor.side_multiple}"
            )
        if stages < asked.stages:
            on_source = "" if views > 1 else " that tunes on the source alone"
            lines.append(
                f"stages: {stages}{on_source} in place of {asked.stages}, as {views} views leave"
                " no more to edit"
            )
        size = self.latent_size(self.source)
        others = [k for k in range(views) if self.latent_size(k) != size]
        if asked.noise == "surface" and others:
            lines.append(
                f"noise: that of {len(others)} of {views} views does not stick to the surface, as"
                f" their edits have another size than the source's (first: {self.names[others[0]]})"
                "; crop the pictures to one shape"
            )
        if self._wants_attention and not self.attends:
            lines.append(
                "unseen: marked parts that no warp reaches are edited freely, as no self-attention"
                " of a UNet is recorded that could attend to the source"
            )
        if self.features.layers:
            lines.append(str(self._plan))
            if self.attends:
                lines.append(f"for what no warp reaches, {self._tokens_plan(self._plan)}")
        return lines

    # --- the source

    @property
    def recorded(self) -> RecordedSource:
        """The source with its features. A process that found its edit finished repeats the edit,
        with the same bytes.
        """
        if self._recorded is None:
            name = self.names[self.source]
            self.work.report.log(f"recording the features of {name} again")
            (again,) = self.edit_source(self.work.frozen, lambda: None)
            pixels = to_bytes(self.work.composite(self.source, again.picture))
            self.work.folder.check_same(edit_file(0, name), pixels)
        assert self._recorded is not None
        return self._recorded

    def keep(self, source: RecordedSource) -> None:
        """Keep the source's edit for the views that take its features."""
        self._recorded = source

    def warp(self, view: int, model: Gaussians) -> WarpedView | None:
        """Compute the warp from the source to a view; None if nothing is warped."""
        s = self.settings
        if s.a0 > 0 or s.noise == "surface" or s.reference == "warped":
            return self.geometry.warp(self.source, view, model)
        return None

    def of_features(self, warp: WarpedView | None) -> WarpedView | ZeroPadded | None:
        """Surround features by zeros, if the settings say so."""
        zeros = not self.settings.mask and self.settings.outside == "zeros"
        return ZeroPadded(warp) if warp is not None and zeros else warp

    # --- an edit

    def start(
        self, views: Sequence[int], model: Gaussians, *, stage: int = 0, by_hand: bool = False
    ) -> Start:
        """Prepare views' edits, before features are recorded or injected.

        Args:
            stage: number of the stage, from 0; the source is edited in the first.
            by_hand: True replays the edit made elsewhere, if given.
        """
        work, s = self.work, self.settings
        before = work.frozen if s.depth_from == "frozen" else model
        guides = [work.guide(view, before, s.warp) for view in views]
        if by_hand and self.by_hand is not None:
            task = work.editor.task(guides, work.prompt)
            maps = noise_maps(work.editor, task, self.by_hand, self._timesteps(), s.seed)
            return Start(views, guides, replayed=(self.by_hand, task, maps))
        if not s.inverts(stage) and self.timestep is None:
            return Start(views, guides)
        original = s.start_picture == "original" or (s.start_picture == "by_stage" and stage == 0)
        pictures = [work.picture(view) if original else work.render(view, model) for view in views]
        if not s.inverts(stage):
            return Start(views, guides, pictures)
        prompt = work.prompt if s.source_prompt is None else s.source_prompt
        latents = torch.cat(
            [
                invert_view(work.editor, guide, picture, prompt, steps=s.steps, seed=s.seed)
                for guide, picture in zip(guides, pictures, strict=True)
            ]
        )
        return Start(views, guides, latents=latents)

    def referenced(self, start: Start, warps: Sequence[WarpedView | None]) -> Start:
        """Show the source's edit beside the views' guides, as settings say."""
        kind = self.settings.reference
        if kind == "none":
            return start
        edited, guides = self.recorded.picture, []
        for guide, warp in zip(start.guides, warps, strict=True):
            if kind == "plain":
                shown = resized(edited, (guide.shape[0], guide.shape[1]))
            else:
                assert warp is not None
                own, source = (torch.from_numpy(p).permute(2, 0, 1) for p in (guide, edited))
                shown = carry(own, source, warp).permute(1, 2, 0).numpy().clip(0, 1)
            guides.append(np.stack([guide, shown]))
        return replace(start, guides=guides)

    def denoise(
        self, start: Start, warps: Sequence[WarpedView | None], step: Callable[[], None]
    ) -> list[Image]:
        """Edit views from their start, as (h, w, 3) pictures in [0, 1]."""
        work, s = self.work, self.settings
        if start.replayed is not None:
            picture, task, maps = start.replayed
            replay(work.editor.schedule, task.predict, maps, on_step=lambda *_: step())
            return [picture]
        noise = None
        if start.latents is None:
            shape = work.editor.noise_shape(work.sizes[start.views[0]])
            noise = initial_noise(s, start.views, shape, self.latent_size(self.source), warps)
        return edit(
            work.editor,
            start.guides,
            work.prompt,
            steps=s.steps,
            start=self.timestep,
            grid=s.grid,
            pictures=start.pictures or None,
            noise=noise,
            latents=start.latents,
            on_step=lambda *_: step(),
            regions=work.regions(start.views),
        ).images

    def _timesteps(self) -> Sequence[Time]:
        """Timesteps of the source's edit."""
        s, schedule = self.settings, self.work.editor.schedule
        if self.timestep is None:
            return schedule.timesteps(s.steps, self.latent_size(self.source))
        return schedule.published(self.timestep, s.steps, s.grid)

    def latent_size(self, view: int) -> Size:
        """(h, w) of a view's latents."""
        return self.work.editor.noise_shape(self.work.sizes[view])[1:]

    def rows_of_source(self) -> int:
        """Rows through the UNet for the source's edit; an edit made elsewhere is inverted first."""
        rows = self.rows(1, self.features.source_guidance, 0)
        return rows if self.by_hand is None else 2 * rows

    def rows(self, views: int, guidance: float | None, stage: int) -> int:
        """Rows through the UNet for the edits of a stage's views, given the text guidance."""
        s = self.settings
        rows = views * s.steps * len(self.features.branches(guidance))
        if s.inverts(stage):
            rows += views * inversion_rows(self.work.editor, s.steps)
        return rows

    # --- results for inspection

    def result(self, view: int, picture: Image, warp: WarpedView | None = None) -> ViewEdit:
        """Collect a view's edit with its record and pictures."""
        about: dict[str, Any] = {"injected": 0.0}
        pictures, recording = {}, self.recorded.recording
        if view == self.source:
            about["feature_bytes"] = 0 if recording is None else recording.plan.bytes
        elif warp is not None and recording is not None:
            about["injected"] = float(warp.mask.float().mean())
            about["rules"] = {k: float(rule.float().mean()) for k, rule in warp.rules.items()}
            pictures["masks"] = mask_picture(warp.mask)
        return ViewEdit(picture, about, pictures)

    def clear(self) -> None:
        """Remove recordings on disk: recordings of a killed process are never read."""
        if self.folder.is_dir():
            shutil.rmtree(self.folder)


@dataclass(frozen=True, eq=False)
class RecordedSource:
    """Edit of the source in this process.

    Attributes:
        picture: (h, w, 3) in [0, 1].
        recording: its features; None if their weight is 0.
        tokens: inputs of its self-attention, if unseen tokens attend to them.
    """

    picture: Image
    recording: Recording | None
    tokens: SourceTokens | None = None

    @property
    def bytes(self) -> int:
        """Bytes of what is recorded."""
        kept = () if self.tokens is None else self.tokens.by_pass.values()
        tokens = sum(tensor.nbytes for passes in kept for tensor in passes.values())
        return tokens + (0 if self.recording is None else self.recording.plan.bytes)

    def state(self) -> dict[str, Any]:
        """Return tensors and plain values, from which :meth:`of_state` makes it again."""
        return {
            "picture": torch.from_numpy(self.picture),
            "recording": None if self.recording is None else self.recording.state(),
            "tokens": None if self.tokens is None else self.tokens.by_pass,
        }

    @classmethod
    def of_state(cls, state: Mapping[str, Any], plan: RecordingPlan | None) -> RecordedSource:
        """Make it from its :meth:`state` and the plan of its recording, if anything is recorded."""
        recording, tokens = state["recording"], state["tokens"]
        return cls(
            state["picture"].numpy(),
            None if plan is None else Recording.of_state(plan, recording),
            None if tokens is None else SourceTokens(tokens),
        )


@dataclass(frozen=True, eq=False)
class Start:
    """Initial state of views' edits.

    Attributes:
        pictures: pictures to noise to the first timestep; None for pure noise.
        latents: (B, C, h, w) latents of an inversion, or None.
        replayed: picture and noise of an edit made elsewhere, or None.
    """

    views: Sequence[int]
    guides: Sequence[Guide]
    pictures: Sequence[Image] = ()
    latents: Tensor | None = None
    replayed: tuple[Image, Any, NoiseMaps] | None = None

    def part(self, part: slice) -> Start:
        """Return some of the views."""
        return replace(
            self,
            views=self.views[part],
            guides=self.guides[part],
            pictures=self.pictures[part],
            latents=None if self.latents is None else self.latents[part],
        )


def check_editor(editor: Editor, settings: AttentionWarpingSettings) -> int | None:
    """Draw the Stable Diffusion timestep at which all edits start; None for pure noise."""
    s = settings
    if s.reference != "none" and editor.references == 0:
        raise ValueError(
            f"reference: got {s.reference!r}, but {type(editor).__name__} sees one picture alone;"
            " set it to 'none', or choose an editor that sees several"
        )
    if s.latents != "random":
        if s.source_prompt:
            editor.check_text(s.source_prompt)
        if editor.guide != "depth":
            raise ValueError(
                f"latents: {s.latents!r} is made for a depth ControlNet, got"
                f" {type(editor).__name__}, which takes pictures; choose another editor, or"
                " 'random'"
            )
    if s.start is None:
        return None
    low, high = s.start
    generator = torch.Generator().manual_seed(s.seed)
    timestep = int(torch.randint(low, high + 1, (1,), generator=generator))
    # This call refuses more steps than there are timesteps.
    editor.schedule.published(timestep, s.steps, s.grid)
    return timestep


register("attention_warping", attention_warping, PRESETS)
