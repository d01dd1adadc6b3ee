"""The methods that an edit through attention warping is compared with. See docs/baselines.md.

All have the same arguments, ``method(gaussians, cameras, images, editor, instruction, settings,
folder=..., budget=..., watch=...)``, and return a :class:`Baseline`.
"""

from __future__ import annotations

from collections.abc import Callable

from attnwarp.baselines.by_view import by_view
from attnwarp.baselines.dge import dge
from attnwarp.baselines.gaussctrl import gaussctrl
from attnwarp.baselines.igs2gs import igs2gs
from attnwarp.baselines.run import Baseline, Options
from attnwarp.baselines.settings import (
    PRESETS,
    BaselineSettings,
    Budget,
    ByViewSettings,
    DGESettings,
    GaussCtrlSettings,
    IGS2GSSettings,
    preset,
)

METHODS: dict[str, Callable[..., Baseline]] = {
    "by_view": by_view,
    "igs2gs": igs2gs,
    "dge": dge,
    "gaussctrl": gaussctrl,
}
"""The methods by name."""

__all__ = [
    "METHODS",
    "PRESETS",
    "Baseline",
    "BaselineSettings",
    "Budget",
    "ByViewSettings",
    "DGESettings",
    "GaussCtrlSettings",
    "IGS2GSSettings",
    "Options",
    "by_view",
    "dge",
    "gaussctrl",
    "igs2gs",
    "preset",
]
