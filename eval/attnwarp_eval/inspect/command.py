"""The command that opens a view of a run, for reports to link to."""

from __future__ import annotations

import os
import shlex


def inspect_command(
    run: str | os.PathLike[str],
    scene: str,
    variant: str,
    view: str,
    *,
    seed: int | None = None,
    color: str | None = None,
    pixel: str | None = None,
) -> str:
    """Command that shows a view of a run in 3D.

    Args:
        scene, variant, view: names in the run.
        seed: a seed of the run; by default the first.
        color: quantity that colours the surface; by default the command's choice.
        pixel: COLUMN,ROW of a target pixel to explain.
    """
    words = ["attnwarp-eval", "inspect", os.fspath(run), "--scene", scene]
    words += ["--variant", variant, "--view", view]
    options = {"--seed": seed, "--color": color, "--pixel": pixel}
    for option, value in options.items():
        if value is not None:
            words += [option, str(value)]
    return shlex.join(words)
