"""Edits of single views for attention warping: guides, initial latents, recorded sources."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from numbers import Integral
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp import check
from attnwarp.digest import digest
from attnwarp.editing.editor import Editor, edit
from attnwarp.editing.inversion import NoiseMaps, inversion_rows, invert_view, noise_maps, replay
from attnwarp.editing.layers import Layer
from attnwarp.editing.recording import Recording, RecordingPlan, in_words
from attnwarp.editing.schedule import Time
from attnwarp.gaussians import Gaussians
from attnwarp.io.names import file_stems
from attnwarp.methods.base import ViewEdit, edit_file
from attnwarp.methods.carried import Noise, carry
from attnwarp.methods.features import Features
from attnwarp.methods.geometry import Geometry, Warps
from attnwarp.methods.pictures import (
    FeaturePictures,
    Image,
    check_view_aspect,
    resized,
    sight_picture,
    to_bytes,
)
from attnwarp.methods.scene import checked_image, to_float
from attnwarp.methods.settings import AttentionWarpingSettings
from attnwarp.methods.sight import Sight, Size
from attnwarp.methods.unseen import (
    SourceTokens,
    attending,
    has_self_attention,
    kept_tokens,
    unseen_of,
)
from attnwarp.methods.work import Guide, Work
from attnwarp.workdir import MANIFEST

RECORDING = ".recording"
"""Folder of the recorded features while an edit with ``store="disk"`` is in progress."""


@dataclass(frozen=True, eq=False)
class RecordedSource:
    """Edit of a source in this process.

    Attributes:
        picture: (h, w, 3) in [0, 1].
        recording: features of the source; None if their weight is 0.
        sight: visibility of this source from the earlier ones; None for the first.
        tokens: inputs of the first source's self-attention, if unseen tokens attend to them.
    """

    picture: Image
    recording: Recording | None
    sight: Sight | None = None
    tokens: SourceTokens | None = None


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


class ViewEdits:
    """Editor of single views, with its sources."""

    def __init__(
        self,
        work: Work,
        settings: AttentionWarpingSettings,
        source: int,
        by_hand: npt.NDArray[Any] | None,
        warps: Warps | None,
        store: str,
        edit_source: Callable[..., list[ViewEdit]],
    ) -> None:
        self.work, self.settings, self.edit_source = work, settings, edit_source
        self.names = file_stems(work.scene.cameras)
        check.instance(source, Integral, "source", "a number of a view")
        if not 0 <= source < len(self.names):
            raise ValueError(
                f"source: got {source}, expected a number of a view below {len(self.names)}"
            )
        self.by_hand = None if by_hand is None else self._checked_by_hand(by_hand, source)
        self.timestep = check_editor(work.editor, settings)
        self.folder = work.folder.path / RECORDING
        self.features = Features(work.editor, settings, self.folder if store == "disk" else store)
        self.geometry = Geometry(work, settings, warps)
        self.noise = Noise(settings)
        self.sources = (source, *self._further_sources(source))
        self._recorded: list[RecordedSource] = []
        names = [self.names[view] for view in self.sources]
        self.about = {"source": names[0], "sources": names}
        self.inputs = {"source_picture": None if self.by_hand is None else digest(self.by_hand)}

    @property
    def attends(self) -> bool:
        """True if marked tokens that no warp reaches attend to the first source."""
        able = has_self_attention(self.work.editor.network) and bool(self._attending_layers)
        return self._wants_attention and able

    @property
    def _wants_attention(self) -> bool:
        marked = self.work.scene.segments is not None
        return self.settings.unseen == "attend" and marked and bool(self.features.layers)

    @property
    def _attending_layers(self) -> tuple[Layer, ...]:
        return tuple(layer for layer in self.features.layers if layer.kind == "self")

    def keeping(self, stack: ExitStack, number: int) -> SourceTokens | None:
        """Keep the first source's tokens for views to attend to, until the stack is left."""
        if number or not self.attends:
            return None
        passes = self.settings.feature_range()
        network, layers = self.work.editor.network, self._attending_layers
        return stack.enter_context(kept_tokens(network, layers, self.features.stored, passes))

    def _tokens_plan(self, features: RecordingPlan) -> RecordingPlan:
        branches = self.features.branches(self.features.source_guidance(further=False))
        return replace(features, layers=self._attending_layers, keep=branches, store="cpu")

    def attend(
        self, stack: ExitStack, views: Sequence[int], sights: Sequence[Sight | None]
    ) -> None:
        """Let unseen tokens of views attend to the first source, until the stack is left."""
        tokens = self._recorded[0].tokens if self._recorded else None
        segments = self.work.scene.segments
        if tokens is None or segments is None:
            return
        unseen = [
            unseen_of(sight, segments[view])
            for view, sight in zip(views, sights, strict=True)
            if sight is not None
        ]
        network, layers = self.work.editor.network, self._attending_layers
        size, passes = self.latent_size(views[0]), self.settings.feature_range()
        stack.enter_context(attending(network, layers, size, tokens, unseen, passes))

    def _checked_by_hand(self, picture: npt.NDArray[Any], source: int) -> Image:
        """Check an edit made elsewhere and resize it to the source's edit."""
        check.shape(np.asarray(picture), ("H", "W", 3), "source_picture")
        image = to_float(checked_image(picture, "source_picture"))
        size = (image.shape[0], image.shape[1])
        check_view_aspect(size, self.work.scene.cameras[source], "source_picture")
        if self.settings.latents == "inversion":
            raise ValueError(
                "source_picture: got one with latents 'inversion', but its own noise is replayed;"
                " leave it out, or set latents to 'random'"
            )
        return resized(image, self.work.sizes[source])

    def _further_sources(self, source: int) -> tuple[int, ...]:
        """Sources after the first; a resumed run keeps the sources of its folder."""
        if self.settings.sources == 1:
            return ()
        if self.work.folder.has(MANIFEST):
            names = self.work.folder.read_json(MANIFEST).get("sources", [])[1:]
            if set(names) <= set(self.names):  # else the claim refuses the folder
                return tuple(self.names.index(name) for name in names)
        with self.work.folder.seconds.part("warp"):
            return self.geometry.chain(source)

    def check_stages(self, stages: int) -> None:
        """Refuse, before any work, branches that a stage lacks."""
        self.features.check_batches(
            range(stages), further=len(self.sources) > 1, attends=self.attends
        )

    def notes(self, stages: int) -> list[str]:
        """Describe settings that the views or the editor limit, one line each."""
        asked, views = self.settings, len(self.names)
        longest, lines = max(self.work.sizes[self.sources[0]]), []
        if asked.size is not None and longest != asked.size:
            lines.append(
                f"size: {longest} px in place of {asked.size}, as this editor's sides are multiples"
                f" of {self.work.editor.side_multiple}"
            )
        if len(self.sources) < asked.sources:
            lines.append(
                f"sources: {len(self.sources)} in place of {asked.sources}, as there are {views}"
                " views"
            )
        if stages < asked.stages:
            on_sources = "" if views > len(self.sources) else " that tunes on the sources alone"
            lines.append(
                f"stages: {stages}{on_sources} in place of {asked.stages}, as {views} views leave"
                " no more to edit"
            )
        if self._wants_attention and not self.attends:
            lines.append(
                "unseen: marked parts that no warp reaches are edited freely, as no self-attention"
                " of a UNet is recorded that could attend to the source"
            )
        if self.features.layers:
            plans = [
                self.features.plan(view, self.latent_size(view), further=number > 0)
                for number, view in enumerate(self.sources)
            ]
            lines.append(in_words(plans))
            if self.attends:
                lines.append(f"for what no warp reaches, {in_words([self._tokens_plan(plans[0])])}")
        return lines

    # --- sources

    def recorded(self, count: int) -> list[RecordedSource]:
        """Return the first ``count`` sources with their features. A process that found their edits
        finished repeats the edits, with the same bytes.
        """
        while len(self._recorded) < count:
            number = len(self._recorded)
            view = self.sources[number]
            self.work.report.log(f"recording the features of {self.names[view]} again")
            (again,) = self.edit_source(number, self.work.frozen, lambda: None)
            pixels = to_bytes(self.work.composite(view, again.picture))
            self.work.folder.check_same(edit_file(0, self.names[view]), pixels)
        return self._recorded[:count]

    def keep(self, number: int, source: RecordedSource) -> None:
        """Keep a source's edit for the views that take its features."""
        del self._recorded[number:], self.noise.orders[number:]
        self._recorded.append(source)
        size = self.latent_size(self.sources[number])
        self.noise.orders.append(self.noise.order(source.sight, size))

    def sight(self, sources: int, view: int, model: Gaussians) -> Sight | None:
        """Compute the visibility of a view from the first sources; None if nothing is warped."""
        s = self.settings
        warps = s.a0 > 0 or s.noise == "surface" or s.reference == "warped"
        if not sources or not warps:
            return None
        return self.geometry.sight(self.sources[:sources], view, model)

    # --- an edit

    def start(
        self, views: Sequence[int], model: Gaussians, *, stage: int = 0, by_hand: bool = False
    ) -> Start:
        """Prepare views' edits, before features are recorded or injected.

        Args:
            stage: number of the stage, from 0; sources are edited in the first.
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

    def referenced(self, start: Start, sights: Sequence[Sight | None], sources: int) -> Start:
        """Show the edits of the first ``sources`` beside the views' guides, as settings say."""
        kind, edits = self.settings.reference, [s.picture for s in self._recorded[:sources]]
        if kind == "none" or not edits:
            return start
        guides = []
        for guide, sight in zip(start.guides, sights, strict=True):
            size = guide.shape[0], guide.shape[1]
            if kind == "plain":
                shown = [resized(edit, size) for edit in edits[: self.work.editor.references]]
            else:
                assert sight is not None
                own, *maps = (torch.from_numpy(p).permute(2, 0, 1) for p in (guide, *edits))
                warps = [sight.warp(number, picture=True) for number in range(len(edits))]
                shown = [carry(own, maps, warps, 1.0).permute(1, 2, 0).numpy().clip(0, 1)]
            guides.append(np.stack([guide, *shown]))
        return replace(start, guides=guides)

    def denoise(
        self, start: Start, sights: Sequence[Sight | None], step: Callable[[], None]
    ) -> list[Image]:
        """Edit views from their start, as (h, w, 3) pictures in [0, 1]."""
        work, s = self.work, self.settings
        if start.replayed is not None:
            picture, task, maps = start.replayed
            replay(work.editor.schedule, task.predict, maps, on_step=lambda *_: step())
            return [picture]
        shape = work.editor.noise_shape(work.sizes[start.views[0]])
        return edit(
            work.editor,
            start.guides,
            work.prompt,
            steps=s.steps,
            start=self.timestep,
            grid=s.grid,
            pictures=start.pictures or None,
            noise=self.noise.of(start.views, shape, sights) if start.latents is None else None,
            latents=start.latents,
            on_step=lambda *_: step(),
            regions=work.regions(start.views),
        ).images

    def _timesteps(self) -> Sequence[Time]:
        """Timesteps of the source's edit."""
        s, schedule = self.settings, self.work.editor.schedule
        if self.timestep is None:
            return schedule.timesteps(s.steps, self.latent_size(self.sources[0]))
        return schedule.published(self.timestep, s.steps, s.grid)

    def latent_size(self, view: int) -> Size:
        """(h, w) of a view's latents."""
        return self.work.editor.noise_shape(self.work.sizes[view])[1:]

    def rows_of_source(self, number: int) -> int:
        """Rows through the UNet for a source's edit; an edit made elsewhere is inverted first."""
        guidance = self.features.source_guidance(further=number > 0)
        by_hand = number == 0 and self.by_hand is not None
        return self.rows(1, guidance, 0) * (2 if by_hand else 1)

    def rows(self, views: int, guidance: float | None, stage: int) -> int:
        """Rows through the UNet for the edits of a stage's views, given the text guidance."""
        s = self.settings
        rows = views * s.steps * len(self.features.branches(guidance))
        if s.inverts(stage):
            rows += views * inversion_rows(self.work.editor, s.steps)
        return rows

    # --- results for inspection

    def result(self, view: int, picture: Image, sight: Sight | None, sources: int) -> ViewEdit:
        """Collect a view's edit with its record and pictures.

        Args:
            sources: number of sources available to the view; for a source, its index.
        """
        about: dict[str, Any] = {"injected": 0.0}
        pictures = {}
        own = self._recorded[sources] if self.sources.count(view) else None
        if own is not None:
            plan = None if own.recording is None else own.recording.plan
            about["feature_bytes"] = 0 if plan is None else plan.bytes
        recordings = [s.recording for s in self._recorded[:sources] if s.recording is not None]
        shape = self.work.scene.images[view].shape[:2]
        if sight is not None and recordings:
            about["injected"] = float(sight.mask.float().mean())
            rules = sight.views[0].rules
            about["rules"] = {k: float(rule.float().mean()) for k, rule in rules.items()}
            if sources > 1:
                choice = sight.choice((sight.mask.shape[0], sight.mask.shape[1]))
                about["sources"] = {
                    self.names[source]: float((choice == number).float().mean())
                    for number, source in enumerate(self.sources[:sources])
                }
            pictures["masks"] = sight_picture(sight)
            pictures["features"] = self._shown.of_target(
                recordings, sight, self.latent_size(view), shape
            )
        elif own is not None and own.recording is not None:
            pictures["features"] = self._shown.of_source(own.recording, shape)
        return ViewEdit(picture, about, pictures)

    @property
    def _shown(self) -> FeaturePictures:
        """Colours of features, from the first source's principal components."""
        first = self._recorded[0].recording
        assert first is not None
        return FeaturePictures(first)

    def clear(self) -> None:
        """Remove recordings on disk: recordings of a killed process are never read."""
        if self.folder.is_dir():
            shutil.rmtree(self.folder)
