"""The command that opens a view of a run, for reports to link to."""

from __future__ import annotations

import os
import shlex


def inspect_command(
    run: str | os.PathLike[str], scene: str, variant: str, view: str, *, pixel: str | None = None
) -> str:
    """What to type to see a view of a run in 3D.

    Args:
        run: folder of the run.
        scene, variant, view: as the run names them.
        pixel: COLUMN,ROW of a target pixel to explain.

    Example:
        >>> inspect_command("runs/demo", "bear", "bounds only", "yaw060")
        "attnwarp-eval inspect runs/demo --scene bear --variant 'bounds only' --view yaw060"
    """
    words = ["attnwarp-eval", "inspect", os.fspath(run), "--scene", scene]
    words += ["--variant", variant, "--view", view]
    if pixel is not None:
        words += ["--pixel", pixel]
    return shlex.join(words)
