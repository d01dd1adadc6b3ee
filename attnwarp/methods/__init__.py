"""Methods that edit a scene: attention warping, and the baselines it is compared with.

All have the same arguments, ``method(gaussians, cameras, images, editor, instruction, settings,
folder=..., budget=..., report=...)``, and return a :class:`Result`.
"""

from __future__ import annotations

from attnwarp.methods.algorithms.attention_warping import attention_warping
from attnwarp.methods.algorithms.by_view import ByViewSettings, by_view
from attnwarp.methods.algorithms.corresponding import CorrespondingSettings, corresponding
from attnwarp.methods.algorithms.dge import DGESettings, dge
from attnwarp.methods.algorithms.fused import FusedSettings, fused
from attnwarp.methods.algorithms.gaussctrl import GaussCtrlSettings, gaussctrl
from attnwarp.methods.algorithms.guided import GuidedSettings, guided
from attnwarp.methods.algorithms.igs2gs import IGS2GSSettings, igs2gs
from attnwarp.methods.algorithms.warped_reference import WarpedReferenceSettings, warped_reference
from attnwarp.methods.attention_settings import AttentionWarpingSettings
from attnwarp.methods.base import Options, Result, Round
from attnwarp.methods.doors import METHODS
from attnwarp.methods.settings import PRESETS, MethodSettings, preset
from attnwarp.workdir import Budget

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
