"""Recorded features of an edit: their layers, guidance branches and memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from attnwarp.editing.editor import Editor, guided
from attnwarp.editing.layers import Layer, choose_layers
from attnwarp.editing.recording import RecordingPlan
from attnwarp.methods.settings import AttentionWarpingSettings
from attnwarp.methods.sight import Size


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

    def source_guidance(self, *, further: bool) -> float | None:
        """Text guidance of a source; None for the editor's default. Further sources use stage 0."""
        s = self.settings
        own = None if further else s.source_text_guidance
        return s.guidance(0) if own is None else own

    def plan(self, view: int, size: Size, *, further: bool) -> RecordingPlan:
        """Plan the recording of a source."""
        s = self.settings
        branches = self.branches(self.source_guidance(further=further))
        return RecordingPlan(
            self.layers,
            size,
            self._kept(branches),
            s.steps,
            dtype=self.stored,
            store=self.store / str(view) if isinstance(self.store, Path) else self.store,  # type: ignore[arg-type]
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
        guidance = self.source_guidance(further=False)
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

    def check_batches(self, stages: Sequence[int], *, further: bool, attends: bool) -> None:
        """Refuse, before any work, source branches that a later batch lacks, and any difference of
        branches if views attend to the source.
        """
        if not self.layers:
            return
        s = self.settings
        guidances = {"a further source": s.guidance(0)} if further else {}
        recorded = [
            self._kept(self.branches(guidance))
            for guidance in (self.source_guidance(further=False), *guidances.values())
        ]
        guidances |= {f"stage {number + 1}": s.guidance(number) for number in stages}
        for name, guidance in guidances.items():
            branches = self.branches(guidance)
            source = self.source_guidance(further=False)
            if attends and branches != self.branches(source):
                raise ValueError(
                    f"unseen: attends to the source, which has {', '.join(self.branches(source))}"
                    f" at {_in_words(source)}, but at {_in_words(guidance)} {name} has"
                    f" {', '.join(branches)}; set unseen to 'free', or choose another"
                    " text_guidance, source_text_guidance or guidance_drop"
                )
            # A further source also records the branches named by the settings.
            needs_all = name == "a further source" and s.branches is not None
            for keep in recorded:
                shared = set(keep) & set(branches)
                if not shared or (needs_all and len(shared) < len(set(keep))):
                    raise ValueError(
                        f"branches: {', '.join(keep) or 'none'} would be recorded, but at"
                        f" {_in_words(guidance)} {name} has {', '.join(branches)}; choose other"
                        " branches, text_guidance, source_text_guidance or guidance_drop"
                    )


def _in_words(guidance: float | None) -> str:
    own = "the editor's own text guidance"
    return own if guidance is None else f"text guidance {guidance:g}"
