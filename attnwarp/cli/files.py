"""Files read and written by commands."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attnwarp.cli.bundled_scene import scenes
from attnwarp.cli.options import Kind, Reading
from attnwarp.errors import InputError, InputWarning, suggest

if TYPE_CHECKING:
    from attnwarp.camera import Camera
    from attnwarp.gaussians import Gaussians
    from attnwarp.io import Dataset
    from attnwarp.reporting import Reporter

COVERED = 0.002
"""Share of a picture that splats must cover to be editable: 8 pixels of 64 x 64."""

LOOK_SIZE = 256
"""Longest side in px of renders that search for splats; full size would take seconds."""

LOOKS = 6
"""Number of views whose renders are compared with their pictures."""

ALIKE = 18.0
"""PSNR of renders, dB, above which splats certainly fit their pictures."""

UNSEEN = (
    "check that the splats and the cameras are of one scene, in the same coordinates and the same"
    " units"
)
"""Remedy in messages if cameras do not see splats."""


def read_views(path: Path, reading: Reading, **options: Any) -> Dataset:
    """Read the dataset at ``path``. A scene name raises an error that explains how to export
    it.

    Args:
        options: keywords of `attnwarp.io.read_dataset` set by the command, which override reading
            options.
    """
    from attnwarp.io import read_dataset

    export = f"attnwarp-eval scenes export {path} DIR"
    if path.suffix in (".yaml", ".yml") and not path.is_dir():
        raise ValueError(
            f"{path}: expected transforms.json, its folder or a COLMAP folder; for a scene:"
            f" {export}, then give DIR"
        )
    if not path.exists():
        scene = f"; for a scene: {export}, then give DIR"
        known = scenes()
        raise FileNotFoundError(
            f"{path}: no such file or folder"
            f"{scene if str(path) in known else suggest(str(path), known)}"
        )
    typed = {**vars(reading), "ignore_keys": reading.ignore_keys or ()}
    return read_dataset(path, **(typed | options))


def read_splats(
    path: Path, kind: Kind | None, antialiased: bool | None, screen_filter: float | None = None
) -> Gaussians:
    """Read the splats of a .ply or .splat file; the other arguments override the file."""
    from dataclasses import replace

    from attnwarp.io import read_ply, read_splat

    if path.suffix.lower() == ".splat":
        if kind == "2dgs":
            raise ValueError(f"--kind: {path} is a .splat, which holds 3DGS alone")
        splats = replace(read_splat(path), antialiased=bool(antialiased))
        return splats if screen_filter is None else replace(splats, screen_filter=screen_filter)
    splats = read_ply(
        path,
        kind=None if kind is None else "2d" if kind == "2dgs" else "3d",
        antialiased=antialiased,
        screen_filter=screen_filter,
    )
    given = {"--antialiased": antialiased, "--screen-filter": screen_filter}
    for option in (name for name, value in given.items() if value):
        if splats.kind == "2d":
            raise ValueError(f"{option}: {path} holds 2DGS, which has a screen filter of its own")
    return splats


def check_seen(path: Path, splats: Gaussians, cameras: Sequence[Camera], report: Reporter) -> None:
    """Refuse splats that no camera sees, before an edit spends minutes on them."""
    import torch

    from attnwarp.fit import compile_kernels
    from attnwarp.methods.scene import near_of
    from attnwarp.render import render

    compile_kernels(splats.kind, report)
    near = near_of(cameras, splats)
    with torch.no_grad():
        for camera in cameras:
            factor = min(1.0, LOOK_SIZE / max(camera.width, camera.height))
            w, h = (max(1, round(factor * side)) for side in (camera.width, camera.height))
            if float(render(splats, camera.resize(w, h), near=near).alpha.mean()) >= COVERED:
                return
    raise InputError(f"{path}: its splats cover less than {COVERED:.1%} of each view; {UNSEEN}")


def note_held_out(path: Path, dataset: Dataset, index: int) -> str:
    """Write a sentence if the edit's source was not fitted; empty if fitted or unknown.

    Args:
        path: path of the splats. A fit writes its held-out views to the same folder.
    """
    from attnwarp.io.names import file_stems

    pictured = dataset.with_pictures()
    name = file_stems(pictured.cameras)[index]
    if (
        pictured.splits[index] in (None, "train")
        and not (path.parent / "held_out" / f"{name}.png").is_file()
    ):
        return ""
    return (
        f"{path} was not fitted to the source {name}, which was held out: depth, mask and warp are"
        " less sure there; name a view that was fitted by --source"
    )


def warn_of_misfit(path: Path, splats: Gaussians, dataset: Dataset) -> None:
    """Warn of splats whose renders differ from the pictures, such as splats moved by a trainer.

    A render farther from its picture than a uniform colour explains nothing of the picture.
    """
    psnr, plain = likeness(splats, dataset)
    if psnr < min(plain, ALIKE):
        warnings.warn(
            f"{path}: where its splats cover the pictures, their renders are unlike them"
            f" ({psnr:.1f} dB; one colour a view would have {plain:.1f}); {UNSEEN}: nerfstudio and"
            " gsplat turn, move and scale a scene before they fit it",
            InputWarning,
            stacklevel=2,
        )


def likeness(splats: Gaussians, dataset: Dataset) -> tuple[float, float]:
    """Compute the PSNR in dB, where splats cover some views, of renders and of one uniform colour
    per view; infinite if splats cover none.
    """
    import numpy as np
    import torch

    from attnwarp.fit import load_views
    from attnwarp.methods.scene import near_of
    from attnwarp.render import render

    pictured = dataset.with_pictures()
    spread_out = np.linspace(0, len(pictured) - 1, LOOKS if pictured else 0).round().astype(int)
    chosen = pictured.select(list(dict.fromkeys(spread_out.tolist())))
    views = load_views(chosen, max_size=LOOK_SIZE)
    near = near_of(dataset.cameras, splats)
    error = spread = 0.0
    count = 0
    for camera, image, kept in zip(views.cameras, views.images, views.masks, strict=True):
        with torch.no_grad():
            view = render(splats, camera, near=near)
        alpha = view.alpha.numpy()
        top = np.iinfo(image.dtype).max if image.dtype.kind == "u" else 1
        colors = image.astype(np.float64) / top
        shown = alpha > 0.5
        if image.shape[2] == 4:
            shown &= colors[..., 3] > 0.5
        if kept is not None:
            shown &= kept
        if not shown.any():
            continue
        true = colors[shown, :3]
        error += float(((view.color.numpy()[shown] / alpha[shown, None] - true) ** 2).sum())
        spread += float(((true - true.mean(0)) ** 2).sum())
        count += true.size
    if not count:
        return math.inf, math.inf
    psnr, plain = (-10 * math.log10(max(value, 1e-9) / count) for value in (error, spread))
    return psnr, plain


def check_inputs_stay(results: Iterable[Path], read: Iterable[Path | None]) -> None:
    """Refuse to overwrite a command's inputs, under the same or another name, or by a link."""
    # Writing a PLY to a link replaces the link's target.
    existing = {_identity(look): path for path in results for look in (path.lstat, path.stat)}
    existing.pop(None, None)
    for path in read:
        if path is None:
            continue
        for look in (path.lstat, path.stat):
            result = existing.get(_identity(look))
            if result is not None:
                raise InputError(
                    f"{result}: is read, and a result would replace it; name another folder with"
                    " --out"
                )


def _identity(look: Callable[[], os.stat_result]) -> tuple[int, int] | None:
    """Return a file's device and inode; None if the file does not exist."""
    try:
        status = look()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def write_image(path: Path, rgb: Any) -> None:
    """Write (H, W, 3) sRGB in [0, 1] as an 8-bit PNG, atomically."""
    from attnwarp.io.file import write_atomically
    from attnwarp.io.picture import encode_picture

    write_atomically(path, lambda stream: stream.write(encode_picture(rgb)))
