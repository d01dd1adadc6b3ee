"""Recorded features of an edit: their layers, guidance branches and memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from attnwarp.editing.editor import Editor, guided
from attnwarp.editing.layers import Layer, choose_layers
from attnwarp.editing.recording import RecordingPlan
from attnwarp.editing.schedule import Size
from attnwarp.methods.attention_settings import AttentionWarpingSettings


class Features:
    """Selection of the features to record.

    Attributes:
        layers: layers to record; empty if the features' weight is 0.
    """

    def __init__(
        self, editor: Editor, settings: AttentionWarpingSettings, store: str | Path
    ) -> None:
        self.editor, self.settings, self.store = editor, settings, store
        self.layers: tuple[Layer, ...] = ()
        if settings.a0 > 0:
            self.layers = choose_layers(
                editor.layers(),
                kinds=settings.kinds,
                blocks=settings.blocks,
                sets=editor.block_sets,
            )
            self._check_branches()

    @property
    def source_guidance(self) -> float | None:
        """Text guidance of the source; None for the editor's default."""
        own = self.settings.source_text_guidance
        return self.settings.guidance(0) if own is None else own

    def plan(self, size: Size) -> RecordingPlan:
        """Plan the recording of the source."""
        s = self.settings
        branches = self.branches(self.source_guidance)
        return RecordingPlan(
            self.layers,
            size,
            self._kept(branches),
            s.steps,
            dtype=self.stored,
            store=self.store,  # type: ignore[arg-type]
            chosen=s.feature_range(),
        )

    @property
    def stored(self) -> torch.dtype:
        """Precision of recorded features; at most the editor's precision, which is lossless."""
        own, chosen = self.editor.network.dtype, getattr(torch, self.settings.feature_type)
        return own if own.itemsize < chosen.itemsize else chosen

    def branches(self, guidance: float | None) -> tuple[str, ...]:
        """Guidance branches of a batch, given its text guidance."""
        with guided(self.editor, text_guidance=guidance):
            return self.editor.branches

    def _kept(self, branches: tuple[str, ...]) -> tuple[str, ...]:
        """Select the branches to record from a source's branches."""
        if self.settings.branches is not None:
            return self.settings.branches
        return tuple(branch for branch in self.editor.carries if branch in branches)

    def _check_branches(self) -> None:
        guidance = self.source_guidance
        available = self.branches(guidance)
        if self.settings.branches == ():
            raise ValueError(f"branches: got none, expected some of {', '.join(available)}")
        for branch in self.settings.branches or ():
            if branch not in available:
                raise ValueError(
                    f"branches: got {branch!r}, expected one of"
                    f" {', '.join(map(repr, available))}, which the source has at"
                    f" {_in_words(guidance)}"
                )

    def check_batches(self, stages: Sequence[int], *, attends: bool) -> None:
        """Refuse, before any work, source branches that a later batch lacks, and any difference of
        branches if views attend to the source.
        """
        if not self.layers:
            return
        own = self.branches(self.source_guidance)
        kept, at = self._kept(own), _in_words(self.source_guidance)
        change = "text_guidance, source_text_guidance or guidance_drop"
        for number in stages:
            guidance = self.settings.guidance(number)
            branches = self.branches(guidance)
            there = f"at {_in_words(guidance)} stage {number + 1} has {', '.join(branches)}"
            if attends and branches != own:
                raise ValueError(
                    f"unseen: attends to the source, which has {', '.join(own)} at {at}, but"
                    f" {there}; set unseen to 'free', or choose another {change}"
                )
            if not set(kept) & set(branches):
                raise ValueError(
                    f"branches: {', '.join(kept) or 'none'} would be recorded, but {there}; choose"
                    f" other branches, {change}"
                )


def _in_words(guidance: float | None) -> str:
    own = "the editor's own text guidance"
    return own if guidance is None else f"text guidance {guidance:g}"
