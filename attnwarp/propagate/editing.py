"""The edits of source views, recorded, and of target views with their features."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp.editing.attention import (
    Layer,
    Recording,
    RecordingPlan,
    choose_layers,
    constant,
    decay,
    in_words,
    inject,
    record,
)
from attnwarp.editing.editor import Editor, edit, guided, shared_noise
from attnwarp.editing.inversion import edit_friendly_invert, invert_view, replay
from attnwarp.editing.schedule import steps_as_published
from attnwarp.propagate.noise import FRESH, carried, own_seed, unmoved
from attnwarp.propagate.pictures import Image
from attnwarp.propagate.settings import PropagateSettings
from attnwarp.propagate.sight import Sight, SourceWarp

Guide = npt.NDArray[Any]
Store = Literal["device", "cpu"] | Path

BRANCHES = ("text", "image")
"""Branches of InstructPix2Pix that get features in the released code: not the unconditional one."""


@dataclass(frozen=True, eq=False)
class Target:
    """A view to edit.

    Attributes:
        view: its number, which its own noise depends on.
        guide: (h, w, 3) picture or (h, w) depth, as the editor takes it.
        start_picture: (h, w, 3) that is noised to the settings' ``start``, or inverted.
        sight: how the sources see it; None where there are none.
    """

    view: int
    guide: Guide
    start_picture: Image | None = None
    sight: Sight | None = None


@dataclass(frozen=True, eq=False)
class Source:
    """A source's edit.

    Attributes:
        picture: (h, w, 3) in [0, 1].
        recording: its features; None where every view is edited alone.
        branches: of the batch while it was edited.
        noise: (h, w) order of the noise that it started from, where noise sticks to the surface.
        estimates: (C, h, w) clean latents that were predicted at each step, where they are warped.
        decoded: by step, the (3, H, W) picture of an estimate in main memory, once it was needed.
    """

    picture: Image
    recording: Recording | None
    branches: tuple[str, ...]
    noise: Tensor | None = None
    estimates: Sequence[Tensor] = ()
    decoded: dict[int, Tensor] = field(default_factory=dict)


class ViewEditor:
    """An editor with the choices of the settings.

    Args:
        editor: the model.
        instruction: in words.
        settings: see there.
        store: where recorded features go.
        announce: told the memory of the recordings.

    Attributes:
        timestep: Stable Diffusion's, drawn to start from; None for pure noise.

    Raises:
        ValueError: layers or branches that the editor lacks; an inversion of one that changes
            pictures; a start too low for the steps.
    """

    def __init__(
        self,
        editor: Editor,
        instruction: str,
        settings: PropagateSettings,
        *,
        store: Store = "cpu",
        announce: Callable[[str], None] | None = None,
    ) -> None:
        self.editor, self.instruction, self.settings = editor, instruction, settings
        self.store, self.announce = store, announce
        if (
            settings.latents == "inversion"
            and settings.source_prompt
            and hasattr(editor, "check_text")
        ):
            editor.check_text(settings.source_prompt)
        if settings.latents == "inversion" and editor.guide != "depth":
            raise ValueError(
                "latents: 'inversion' is made for a depth ControlNet, got InstructPix2Pix, which"
                " takes pictures; choose another editor, or 'random'"
            )
        self.layers: tuple[Layer, ...] = ()
        if settings.method == "warp":
            self.layers = choose_layers(
                editor.unet,
                fractions=settings.fractions,
                kinds=settings.kinds,
                blocks=settings.blocks,
            )
            self._check_branches()
        self.timestep: int | None = None
        if settings.start is not None:
            low, high = settings.start
            generator = torch.Generator().manual_seed(settings.seed)
            self.timestep = int(torch.randint(low, high + 1, (1,), generator=generator))
            # Refuses more steps than there are timesteps.
            steps_as_published(editor.schedule, self.timestep, settings.steps)

    def source(
        self,
        target: Target,
        before: Sequence[Source] = (),
        *,
        by_hand: Image | None = None,
        watch: Callable[[], None] | None = None,
    ) -> Source:
        """Edit a source view and record its features.

        Args:
            target: the view.
            before: the sources so far, whose features it gets.
            by_hand: (h, w, 3), an edit made elsewhere; its own noise is then replayed.
            watch: called after each step.
        """
        s = self.settings
        features: Recording | None = None
        guidance = s.guidance(0) if before else self._source_guidance()
        latents = self._inverted([target])
        with guided(self.editor, guidance), ExitStack() as stack:
            branches = self.editor.branches
            task = self.editor.task([target.guide], self.instruction)
            maps = None if by_hand is None else self._inversion(task, by_hand)
            self._inject(stack, before, [target], branches)
            if self.layers:
                # After the injection: what the next source gets is what this one went on with.
                _, _, h, w = self._shape(target)
                plan = self._plan(target.view, (h, w), further=bool(before))
                features = stack.enter_context(record(self.editor.unet, plan))
            estimates: list[Tensor] = []
            if by_hand is None or maps is None:
                picture = self._edit([target], before, latents, watch, estimates)[0]
            else:
                replay(self.editor.schedule, task.predict, maps, watch=_ignoring(watch))
                picture = by_hand
                estimates = [self.editor.encode([by_hand])[0]] * s.steps
        noise = self.noise_order(target, before) if s.noise == "surface" else None
        return Source(picture, features, branches, noise, estimates)

    def targets(
        self,
        sources: Sequence[Source],
        targets: Sequence[Target],
        stage: int,
        watch: Callable[[], None] | None = None,
    ) -> list[Image]:
        """Edit target views together, with the sources' features where there are any.

        Args:
            sources: of :meth:`source`.
            targets: the views, all of one size.
            stage: from 0.
            watch: called after each step.
        """
        latents = self._inverted(targets)
        with guided(self.editor, self.settings.guidance(stage)), ExitStack() as stack:
            self._inject(stack, sources, targets, self.editor.branches)
            return self._edit(targets, sources, latents, watch)

    def branches(self, stage: int) -> tuple[str, ...]:
        """Of the batch of a stage's views. Further sources have those of the first stage."""
        return self._branches(self.settings.guidance(stage))

    def announce_recordings(self, sources: Mapping[int, tuple[int, int]]) -> None:
        """Tell the memory of all sources' recordings, before the first is made.

        Args:
            sources: by the view's number, (h, w) of its edit in px; the first source first.
        """
        if self.announce is None or not self.layers:
            return
        factor = self.editor.factor
        plans = [
            self._plan(view, (h // factor, w // factor), further=number > 0)
            for number, (view, (h, w)) in enumerate(sources.items())
        ]
        self.announce(in_words(plans))
        s = self.settings
        if s.estimate_in == "picture" and s.estimate > 0:
            kept = sum(self._estimate_weight(number) > 0 for number in range(s.steps))
            pixels = sum(h * w for h, w in sources.values())
            self.announce(
                f"estimates of {len(sources)} source{'s' * (len(sources) > 1)}, as pictures of"
                f" {kept} steps: up to {12 * kept * pixels / 2**20:.1f} MiB in main memory"
            )

    def _plan(self, view: int, size: tuple[int, int], *, further: bool) -> RecordingPlan:
        """What is recorded of a source whose latents have (h, w)."""
        s = self.settings
        branches = self._branches(s.guidance(0) if further else self._source_guidance())
        return RecordingPlan(
            self.layers,
            size,
            branches,
            self._kept(branches),
            s.steps,
            dtype=torch.float16 if s.feature_type == "float16" else torch.float32,
            store=self.store / str(view) if isinstance(self.store, Path) else self.store,
            chosen=s.feature_range(),
        )

    def _source_guidance(self) -> float | None:
        """Of the first source."""
        s = self.settings
        return s.guidance(0) if s.source_text_guidance is None else s.source_text_guidance

    def _check_branches(self) -> None:
        guidance = self._source_guidance()
        available = self._branches(guidance)
        if self.settings.branches == ():
            raise ValueError(f"branches: got none, expected some of {', '.join(available)}")
        for branch in self.settings.branches or ():
            if branch not in available:
                raise ValueError(
                    f"branches: got {branch!r}, expected one of"
                    f" {', '.join(map(repr, available))}, which the source has at"
                    f" {_in_words(guidance)}"
                )

    def check_batches(self, stages: Sequence[int], *, further: bool) -> None:
        """Refuse, before any work, branches of the source that a later batch does not have.

        Args:
            stages: numbers of the stages that edit views, from 0.
            further: whether there are further sources.

        Raises:
            ValueError: a batch takes none of the recorded branches, or cannot record all that the
                settings name.
        """
        if not self.layers:
            return
        s = self.settings
        guidances = {"a further source": s.guidance(0)} if further else {}
        recorded = [
            self._kept(self._branches(guidance))
            for guidance in (self._source_guidance(), *guidances.values())
        ]
        guidances |= {f"stage {number + 1}": s.guidance(number) for number in stages}
        for name, guidance in guidances.items():
            branches = self._branches(guidance)
            # A further source records what the settings name, too.
            needs_all = name == "a further source" and s.branches is not None
            for keep in recorded:
                shared = set(keep) & set(branches)
                if not shared or (needs_all and len(shared) < len(set(keep))):
                    raise ValueError(
                        f"branches: {', '.join(keep) or 'none'} would be recorded, but at"
                        f" {_in_words(guidance)} {name} has {', '.join(branches)}; choose other"
                        " branches, text_guidance, source_text_guidance or guidance_drop"
                    )

    def _branches(self, guidance: float | None) -> tuple[str, ...]:
        """Of a batch with a text guidance."""
        with guided(self.editor, guidance):
            return self.editor.branches

    def _kept(self, branches: tuple[str, ...]) -> tuple[str, ...]:
        """Branches to record, of a source that has these."""
        if self.settings.branches is not None:
            return self.settings.branches
        if self.editor.guide == "picture":
            return tuple(branch for branch in BRANCHES if branch in branches)
        return branches

    def _inject(
        self,
        stack: ExitStack,
        sources: Sequence[Source],
        targets: Sequence[Target],
        branches: tuple[str, ...],
    ) -> None:
        """Inject every source's features while the stack is open. No pixel takes two sources, so
        their order does not matter.
        """
        s = self.settings
        weight = decay(s.a0) if s.decay == "linear" else constant(s.a0)
        for number, source in enumerate(sources):
            if source.recording is None:
                continue
            warps = [None if t.sight is None else t.sight.warp(number) for t in targets]
            stack.enter_context(
                inject(
                    self.editor.unet,
                    source.recording,
                    branches=branches,
                    warps=warps,
                    weight=weight,
                )
            )

    def _edit(
        self,
        targets: Sequence[Target],
        sources: Sequence[Source],
        latents: Tensor | None,
        watch: Callable[[], None] | None,
        estimates: list[Tensor] | None = None,
    ) -> list[Image]:
        s = self.settings
        noised = [t.start_picture for t in targets if t.start_picture is not None]
        result = edit(
            self.editor,
            [target.guide for target in targets],
            self.instruction,
            steps=s.steps,
            start=self.timestep,
            pictures=None if self.timestep is None else noised,
            noise=self.noise(targets, sources) if latents is None else None,
            latents=latents,
            watch=_ignoring(watch),
            estimate=self._estimate(targets, sources, estimates),
        )
        return result.images

    def _inverted(self, targets: Sequence[Target]) -> Tensor | None:
        """(B, C, h, w) that the views' edits start from; None for noise. Each goes through the
        network alone, before features are recorded or injected.
        """
        s = self.settings
        if s.latents == "random":
            return None
        prompt = self.instruction if s.source_prompt is None else s.source_prompt
        return torch.cat(
            [
                invert_view(
                    self.editor, t.guide, t.start_picture, prompt, steps=s.steps, seed=s.seed
                )
                for t in targets
                if t.start_picture is not None
            ]
        )

    def _estimate(
        self,
        targets: Sequence[Target],
        sources: Sequence[Source],
        store: list[Tensor] | None,
    ) -> Callable[[int, Tensor], Tensor] | None:
        """What stands in the place of the predicted clean latents; ``store`` gets a lone view's."""
        s = self.settings
        if s.estimate == 0:
            return None
        warps = [
            [] if t.sight is None else [t.sight.warp(k, picture=True) for k in range(len(sources))]
            for t in targets
        ]
        pictures = s.estimate_in == "picture"
        carry = self._carry_picture if pictures else _carry

        def change(number: int, x0: Tensor) -> Tensor:
            weight = self._estimate_weight(number)
            result = x0
            if weight > 0 and sources:
                maps = [
                    self._decoded(source, number, x0) if pictures
                    else source.estimates[number].to(x0)
                    for source in sources
                ]  # fmt: skip
                rows = [carry(own, maps, ws, weight) for own, ws in zip(x0, warps, strict=True)]
                result = torch.stack(rows)
            if store is not None:
                store.append(result[0].clone())
            return result

        return change

    def _estimate_weight(self, number: int) -> float:
        """Of a source's estimate at a step, from 0; not above 0 where it is not taken."""
        s = self.settings
        return s.estimate * (1 - number / max(1, s.estimate_until * s.steps))

    def _decoded(self, source: Source, number: int, like: Tensor) -> Tensor:
        """(3, H, W) of a source's estimate at a step, decoded once for all targets."""
        if number not in source.decoded:
            latents = source.estimates[number].to(like)
            source.decoded[number] = self.editor.pixels(latents[None])[0].cpu()
        return source.decoded[number].to(like.device)

    def _carry_picture(
        self, own: Tensor, pictures: Sequence[Tensor], warps: Sequence[SourceWarp], weight: float
    ) -> Tensor:
        """(C, h, w) latents of a target whose picture takes the sources' (3, H, W), warped."""
        before = self.editor.pixels(own[None])
        after = _carry(before[0], pictures, warps, weight)[None]
        # What an autoencoder loses of a picture is lost in both, so that nothing changes where
        # nothing is carried.
        change = self.editor.latents(after) - self.editor.latents(before)
        return own + change[0].to(own)

    def noise(self, targets: Sequence[Target], sources: Sequence[Source] = ()) -> Tensor:
        """(B, C, h, w) noise of views: one for all of a size, one of each view's own, or one that
        sticks to the surface.
        """
        s = self.settings
        if s.noise == "shared":
            _, c, h, w = self._shape(targets[0])
            return shared_noise((len(targets), c, h, w), s.seed)
        if s.noise == "surface":
            rows = [shared_noise(self._shape(target), s.seed)[0].flatten(1) for target in targets]
            orders = [self.noise_order(target, sources) for target in targets]
            return torch.stack(
                [
                    row[:, order.flatten()].unflatten(1, tuple(order.shape))
                    for row, order in zip(rows, orders, strict=True)
                ]
            )
        return torch.cat(
            [shared_noise(self._shape(t), own_seed(s.seed, FRESH, t.view)) for t in targets]
        )

    def noise_order(self, target: Target, sources: Sequence[Source]) -> Tensor:
        """(h, w) int64: the order of a view's noise where noise sticks to the surface; sources of
        another size have none to give.
        """
        _, _, h, w = self._shape(target)
        if target.sight is None:
            return unmoved((h, w))
        orders, positions = [], []
        for source, view in zip(sources, target.sight.views, strict=True):
            order = source.noise
            if order is None or tuple(order.shape) != (h, w):
                return unmoved((h, w))
            orders.append(order)
            positions.append(view.at((h, w), source_size=(h, w)).correspondence.xy)
        return carried(orders, positions, target.sight.choice((h, w)))

    def _shape(self, target: Target) -> tuple[int, int, int, int]:
        """Of one view's latents."""
        h, w = (side // self.editor.factor for side in target.guide.shape[:2])
        return 1, self.editor.unet.config.out_channels, h, w

    def _inversion(self, task: Any, picture: Image) -> Any:
        s = self.settings
        timesteps = (
            self.editor.timesteps(s.steps)
            if self.timestep is None
            else steps_as_published(self.editor.schedule, self.timestep, s.steps)
        )
        latents = self.editor.encode([picture])
        generator = torch.Generator().manual_seed(s.seed + 1)
        noises = torch.randn((s.steps, *latents.shape), generator=generator)
        # The targets start from the noise that the picture's own first state has.
        noises[0] = shared_noise((1, *latents.shape[1:]), s.seed)
        return edit_friendly_invert(
            self.editor.schedule, task.predict, latents, timesteps, noises=noises
        )


def _carry(
    own: Tensor, maps: Sequence[Tensor], warps: Sequence[SourceWarp], weight: float
) -> Tensor:
    """(C, h, w) of a target that takes the sources' (C, h', w') maps, warped.

    Args:
        own: (C, h, w) the target's.
        maps: of the sources.
        warps: from the sources.
        weight: of the sources', in [0, 1].
    """
    tokens = own.flatten(1).T[None].contiguous()
    for warp, map_ in zip(warps, maps, strict=False):
        h, w = own.shape[1:]
        layer = warp.at((h, w), source_size=(map_.shape[1], map_.shape[2]))
        tokens = layer.blend_tokens(map_.flatten(1).T[None].contiguous(), tokens, weight)
    return tokens[0].T.reshape(own.shape)


def _in_words(guidance: float | None) -> str:
    own = "the editor's own text guidance"
    return own if guidance is None else f"text guidance {guidance:g}"


def _ignoring(watch: Callable[[], None] | None) -> Callable[[int, int, Tensor], None] | None:
    return None if watch is None else lambda step, steps, latents: watch()
