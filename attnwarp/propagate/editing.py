"""The edit of the source view, recorded, and of target views with its features."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp.editing.attention import (
    Layer,
    LayerWarp,
    Recording,
    RecordingPlan,
    choose_layers,
    constant,
    decay,
    inject,
    record,
)
from attnwarp.editing.editor import Editor, edit, shared_noise
from attnwarp.editing.inversion import edit_friendly_invert, replay
from attnwarp.editing.schedule import steps_from
from attnwarp.propagate.pictures import Image, Size
from attnwarp.propagate.settings import PropagateSettings

Guide = npt.NDArray[Any]
Store = Literal["device", "cpu"] | Path

BRANCHES = ("text", "image")
"""Branches of InstructPix2Pix that get features in the released code: not the unconditional one."""


@dataclass(frozen=True, eq=False)
class Source:
    """The source's edit.

    Attributes:
        picture: (h, w, 3) in [0, 1].
        recording: its features; None where every view is edited alone.
        branches: of the batch while it was edited.
    """

    picture: Image
    recording: Recording | None
    branches: tuple[str, ...]


class ViewEditor:
    """An editor with the choices of the settings.

    Args:
        editor: the model.
        instruction: in words.
        settings: see there.
        source_size: (h, w) px of the source's edit.
        store: where recorded features go.
        announce: told the memory of a recording before it is made.

    Attributes:
        calls: passes of the UNet so far, times the rows of their batch.
        timestep: drawn to start from; None for pure noise.
    """

    def __init__(
        self,
        editor: Editor,
        instruction: str,
        settings: PropagateSettings,
        source_size: Size,
        *,
        store: Store = "cpu",
        announce: Callable[[str], None] | None = None,
    ) -> None:
        self.editor, self.instruction, self.settings = editor, instruction, settings
        self.source_size, self.store, self.announce = source_size, store, announce
        self.layers: tuple[Layer, ...] = ()
        if settings.method == "warp":
            self.layers = choose_layers(
                editor.unet,
                fractions=settings.fractions,
                kinds=settings.kinds,
                blocks=settings.blocks,
            )
        self.timestep: int | None = None
        if settings.start is not None:
            low, high = settings.start
            generator = torch.Generator().manual_seed(settings.seed)
            self.timestep = int(torch.randint(low, high + 1, (1,), generator=generator))
            steps_from(self.timestep, settings.steps)  # refuses more steps than timesteps

    def source(
        self,
        view: int,
        guide: Guide,
        start_picture: Image | None = None,
        by_hand: Image | None = None,
        watch: Callable[[], None] | None = None,
    ) -> Source:
        """Edit the source view and record its features.

        Args:
            view: number of the source view, which fresh noise depends on.
            guide: of it.
            start_picture: (h, w, 3) that is noised to the settings' ``start``.
            by_hand: (h, w, 3), an edit made elsewhere; its own noise is then replayed.
            watch: called after each step.
        """
        s = self.settings
        value = s.guidance(0) if s.source_text_guidance is None else s.source_text_guidance
        start_pictures = None if start_picture is None else [start_picture]
        with guided(self.editor, value):
            task = self.editor.task([guide], self.instruction)
            recording = (
                record(self.editor.unet, self._plan(task.branches), announce=self.announce)
                if self.layers
                else nullcontext()
            )
            if by_hand is None:
                with recording as features:
                    picture = self._edit([guide], [view], start_pictures, watch)[0]
            else:
                maps = self._inversion(task, by_hand)
                with recording as features:
                    replay(self.editor.schedule, task.predict, maps, watch=_ignoring(watch))
                picture = by_hand
        return Source(picture, features, task.branches)

    def targets(
        self,
        source: Source,
        guides: Sequence[Guide],
        views: Sequence[int],
        warps: Sequence[LayerWarp | None],
        stage: int,
        start_pictures: Sequence[Image] | None = None,
        watch: Callable[[], None] | None = None,
    ) -> list[Image]:
        """Edit target views together, with the source's features where there are any.

        Args:
            source: of :meth:`source`.
            guides: of the views, all of one size.
            views: their numbers, which fresh noise depends on.
            warps: of the views; not used where every view is edited alone.
            stage: from 0.
            start_pictures: as for :meth:`source`.
            watch: called after each step.
        """
        s = self.settings
        with guided(self.editor, s.guidance(stage)):
            if source.recording is None:
                return self._edit(guides, views, start_pictures, watch)
            weight = decay(s.a0) if s.decay == "linear" else constant(s.a0)
            with inject(
                self.editor.unet,
                source.recording,
                branches=self._branches(source, guides[:1]),
                warps=warps,
                weight=weight,
            ):
                return self._edit(guides, views, start_pictures, watch)

    def _edit(
        self,
        guides: Sequence[Guide],
        views: Sequence[int],
        start_pictures: Sequence[Image] | None,
        watch: Callable[[], None] | None,
    ) -> list[Image]:
        s = self.settings
        result = edit(
            self.editor,
            guides,
            self.instruction,
            steps=s.steps,
            start=self.timestep,
            pictures=start_pictures,
            noise=self.noise(guides, views),
            watch=_ignoring(watch),
        )
        return result.images

    def noise(self, guides: Sequence[Guide], views: Sequence[int]) -> Tensor:
        """(B, C, h, w) noise of views: one for all of a size, or one of each view's own."""
        s = self.settings
        shape = self._shape(guides)
        if s.noise == "shared":
            return shared_noise(shape, s.seed)
        one = (1, *shape[1:])
        return torch.cat([shared_noise(one, s.seed + 1 + view) for view in views])

    def _shape(self, guides: Sequence[Guide]) -> tuple[int, int, int, int]:
        h, w = (side // self.editor.factor for side in guides[0].shape[:2])
        return len(guides), self.editor.unet.config.out_channels, h, w

    def _plan(self, branches: tuple[str, ...]) -> RecordingPlan:
        s = self.settings
        h, w = (side // self.editor.factor for side in self.source_size)
        if s.branches is not None:
            keep = s.branches
        elif self.editor.guide == "picture":
            keep = tuple(branch for branch in BRANCHES if branch in branches)
        else:
            keep = branches
        return RecordingPlan(
            self.layers,
            (h, w),
            branches,
            keep,
            s.steps,
            dtype=torch.float16 if s.feature_type == "float16" else torch.float32,
            store=self.store,
        )

    def _branches(self, source: Source, guides: Sequence[Guide]) -> tuple[str, ...]:
        """Of the targets' batch; they differ from the source's where guidance of 1 drops some."""
        s = self.settings
        if s.text_guidance is None and s.source_text_guidance is None:
            return source.branches
        return self.editor.task(guides, self.instruction).branches

    def _inversion(self, task: Any, picture: Image) -> Any:
        s = self.settings
        timesteps = (
            self.editor.timesteps(s.steps)
            if self.timestep is None
            else steps_from(self.timestep, s.steps)
        )
        latents = self.editor.encode([picture])
        generator = torch.Generator().manual_seed(s.seed + 1)
        noises = torch.randn((s.steps, *latents.shape), generator=generator)
        # The targets start from the noise that the picture's own first state has.
        noises[0] = shared_noise((1, *latents.shape[1:]), s.seed)
        return edit_friendly_invert(
            self.editor.schedule, task.predict, latents, timesteps, noises=noises
        )


@contextmanager
def guided(editor: Any, value: float | None) -> Iterator[None]:
    """Use another text guidance while the block runs; None leaves the editor's own."""
    name = "text_guidance" if hasattr(editor, "text_guidance") else "guidance"
    if value is None:
        yield
        return
    before = getattr(editor, name)
    setattr(editor, name, float(value))
    try:
        yield
    finally:
        setattr(editor, name, before)


def _ignoring(watch: Callable[[], None] | None) -> Callable[[int, int, Tensor], None] | None:
    return None if watch is None else lambda step, steps, latents: watch()
