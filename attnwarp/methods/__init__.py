"""Methods that edit a scene: attention warping, and the baselines it is compared with.

All have the same arguments, ``method(gaussians, cameras, images, editor, instruction, settings,
folder=..., budget=..., report=...)``, and return a :class:`Result`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

from attnwarp.errors import Named
from attnwarp.methods.attention_warping import attention_warping
from attnwarp.methods.base import Options, Result, Round
from attnwarp.methods.by_view import by_view
from attnwarp.methods.corresponding import corresponding
from attnwarp.methods.dge import dge
from attnwarp.methods.fused import fused
from attnwarp.methods.gaussctrl import gaussctrl
from attnwarp.methods.guided import guided
from attnwarp.methods.igs2gs import igs2gs
from attnwarp.methods.settings import (
    PRESETS,
    AttentionWarpingSettings,
    ByViewSettings,
    CorrespondingSettings,
    DGESettings,
    FusedSettings,
    GaussCtrlSettings,
    GuidedSettings,
    IGS2GSSettings,
    MethodSettings,
    WarpedReferenceSettings,
    preset,
)
from attnwarp.methods.warped_reference import warped_reference
from attnwarp.workdir import Budget

METHODS: Named[Callable[..., Result]] = Named(
    {name: getattr(import_module(f"{__name__}.{name}"), name) for name in PRESETS}
)
"""Methods by name; each method with presets maps to the function of its module."""

__all__ = [
    "METHODS",
    "PRESETS",
    "AttentionWarpingSettings",
    "Budget",
    "ByViewSettings",
    "CorrespondingSettings",
    "DGESettings",
    "FusedSettings",
    "GaussCtrlSettings",
    "GuidedSettings",
    "IGS2GSSettings",
    "MethodSettings",
    "Options",
    "Result",
    "Round",
    "WarpedReferenceSettings",
    "attention_warping",
    "by_view",
    "corresponding",
    "dge",
    "fused",
    "gaussctrl",
    "guided",
    "igs2gs",
    "preset",
    "warped_reference",
]
