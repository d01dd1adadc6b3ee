"""Marks of the edited part: set by a person in the source view, lifted by splats into all views."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.camera import Camera
from attnwarp.digest import digest
from attnwarp.editing.segment import Mask, cut_out, load_segmenter, segments_of, snap
from attnwarp.errors import InputError, InputWarning
from attnwarp.fit import Views
from attnwarp.fit.views import to_float
from attnwarp.gaussians import Gaussians
from attnwarp.io import read_upright
from attnwarp.methods.pictures import Segment, check_view_aspect, mask_picture, to_bytes
from attnwarp.reporting import Reporter
from attnwarp.warp import lift_masks
from attnwarp.workdir import Workdir

COLORED = 0.1
"""Least spread of a pixel's channels in a coloured picture: a photograph, or a mask of two colours,
given as a mask by mistake."""

HOW = "--at X,Y, --box X0,Y0,X1,Y1, --mask FILE or --where WORDS"
"""Options that mark the edited part, for messages."""

POOR = 0.8
"""Overlap of a mask with its lifted mask below which the splats do not follow the mask."""

HARDLY = 0.5
"""Share of the source view from which on a click marks hardly one thing."""

MARKED = "marked.png"
"""File of an edit's folder: its source view with the mark, unlit outside the mask."""


@dataclass(frozen=True)
class Marks:
    """One way to mark the edited part; no mark edits everything.

    Args:
        box: x0, y0, x1, y1 around the object, in px of the source's picture.
        at: x, y of each point on the object, in px of the source's picture.
        segmenter: finder of the words, see :func:`attnwarp.editing.segment.load_segmenter`.

    Raises:
        InputError: several marks are given, the words have no letter, or a point lacks its y.

    Example:
        >>> from attnwarp.command.marks import Marks
        >>> Marks(at=(64, 68)).of_source, Marks().of_source
        (True, False)
    """

    masks: Path | None = None
    mask: Path | None = None
    box: tuple[float, ...] | None = None
    at: tuple[float, ...] | None = None
    words: str | None = None
    segmenter: str = "clip-parts"

    def __post_init__(self) -> None:
        given = self._given
        if len(given) > 1:
            raise InputError(f"{given[1]}: got {given[0]} too, expected one of the two")
        if len(self.at or ()) % 2:
            raise InputError(f"--at: got {len(self.at or ())} numbers, expected X,Y of each point")
        if self.words is not None and not self.words.strip():
            raise InputError(f"--where: got {self.words!r}, expected words such as 'bear'")

    @property
    def _given(self) -> list[str]:
        options = {
            "--masks": self.masks, "--mask": self.mask, "--box": self.box, "--at": self.at,
            "--where": self.words,
        }  # fmt: skip
        return [name for name, value in options.items() if value is not None]

    @property
    def option(self) -> str:
        """Name of the given option; empty for none."""
        return "".join(self._given)

    @property
    def of_source(self) -> bool:
        """True if only the source view is marked, so that its mask must be lifted."""
        return self.option not in ("", "--masks")


def points(texts: Sequence[str] | None, option: str) -> tuple[float, ...] | None:
    """Parse the points of an option that may be repeated: x, y of each, or None without any.

    Example:
        >>> from attnwarp.command.marks import points
        >>> points(["64,68", "3,4"], "--at")
        (64.0, 68.0, 3.0, 4.0)
    """
    return tuple(v for text in texts or () for v in numbers(text, "X,Y", option) or ()) or None


def pairs(pixels: Sequence[float] | None) -> list[Sequence[float]]:
    """Group coordinates by point."""
    return [(pixels or ())[k : k + 2] for k in range(0, len(pixels or ()), 2)]


def numbers(text: str | None, names: str, option: str) -> tuple[float, ...] | None:
    """Parse the numbers of an option such as ``--at 64,68``.

    Example:
        >>> from attnwarp.command.marks import numbers
        >>> numbers("64,68", "X,Y", "--at")
        (64.0, 68.0)
    """
    if text is None:
        return None
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != len(names.split(",")) or not np.isfinite(values).all():
        raise InputError(f"{option}: got {text!r}, expected {names} in px, such as 64,68")
    return values


def say_unmarked(editor: str, report: Reporter) -> None:
    """Report that an editor paints beyond the named object, and how to mark the object."""
    report.log(
        f"{editor} does not tell things apart: it may paint what lies near, too; mark the thing"
        f" with {HOW}"
    )


def picture_mask(marks: Marks, image: npt.NDArray[Any], size: tuple[int, int]) -> Mask:
    """Segment a picture by a box or a point, (H, W) bool.

    Args:
        size: width and height, in px, of the file that the marks refer to.
    """
    # Shrunk sides are rounded, so a mark on the border could leave the picture.
    scales = [(side / full, side) for side, full in zip(image.shape[1::-1], size, strict=True)]

    def shrunk(numbers: tuple[float, ...] | None) -> list[float] | None:
        if numbers is None:
            return None
        return [min(v * s, side) for v, (s, side) in zip(numbers, scales * 2, strict=False)]

    return cut_out(to_float(image), box=shrunk(marks.box), at=shrunk(marks.at))


def source_mask(
    marks: Marks,
    camera: Camera,
    image: npt.NDArray[Any],
    picture: Path | None,
    size: tuple[int, int],
    out: Path,
    device: str,
    report: Reporter,
    pieces: Sequence[Mask] = (),
) -> Mask:
    """Compute the mask of the marked source view, (H, W) bool.

    Args:
        size: width and height, in px, of the file that coordinates refer to.
        pieces: (H, W) bool surface around each point of ``marks.at``,
            :func:`attnwarp.warp.piece_around`; all True if unknown, and colours alone decide.
    """
    if marks.mask is not None:
        mask = read_mask(marks.mask, camera, beside=picture, option="--mask")
        if not mask.any():
            raise InputError(f"--mask: {marks.mask} is black; white is edited")
    elif marks.words is not None:
        mask = mask_by_words(marks, camera, image, out, device)
    elif marks.at is not None:
        mask = np.logical_or.reduce([
            picture_mask(replace(marks, at=tuple(at)), image, size)
            if piece.all()
            else snap(to_float(image), piece)
            for at, piece in zip(pairs(marks.at), pieces, strict=True)
        ])  # fmt: skip
    else:
        mask = picture_mask(marks, image, size)
    write_marked(marks, image, mask, size, out)
    what = f"{marks.option} {typed(marks, size)}".strip()
    report.log(f"{what} marks {mask.mean():.1%} of the source view {camera.name}: {out / MARKED}")
    if marks.at is not None:
        warn_of_much(mask, f": look at {out / MARKED}")
        report.log(
            "if a part is missing, give --at X,Y again, on it; if too much is lit, --box or --mask"
        )
    return mask


def warn_of_much(mask: Mask, more: str = "") -> None:
    """Warn of a click's mask, (H, W) bool, that is hardly of one thing."""
    edges = sum(bool(line.any()) for line in (mask[0], mask[-1], mask[:, 0], mask[:, -1]))
    if edges >= 2 or mask.mean() >= HARDLY:
        reached = f"reaches {edges} edges" if edges >= 2 else "covers half"
        warnings.warn(
            f"what --at marks {reached} of the picture, so it is hardly one thing{more}; --box"
            " X0,Y0,X1,Y1 of `attnwarp edit` marks the thing by a box",
            InputWarning,
            stacklevel=3,
        )


def typed(marks: Marks, size: tuple[int, int]) -> str:
    """Write a box's or a point's coordinates with the size that they refer to, else nothing."""
    numbers = ",".join(f"{v:g}" for v in marks.box or ())
    if marks.at:
        numbers = " ".join(f"{x:g},{y:g}" for x, y in pairs(marks.at))
    return f"{numbers} of {size[0]} x {size[1]} px" if numbers else ""


def write_marked(
    marks: Marks, image: npt.NDArray[Any], mask: Mask, size: tuple[int, int], out: Path
) -> None:
    """Write :data:`MARKED`, so that a wrong mark is seen before minutes of work.

    Args:
        mask: (H, W) bool what is edited, all True while that is unknown.
        size: width and height, in px, of the file that coordinates refer to.
    """
    import cv2

    picture = np.ascontiguousarray(to_bytes(to_float(image) * np.where(mask, 1, 0.3)[..., None]))
    h, w = mask.shape

    def drawn(pixels: tuple[float, ...]) -> list[list[int]]:
        return [[round(x * w / size[0]), round(y * h / size[1])] for x, y in pairs(pixels)]

    for color, width in (((0, 0, 0), 3), ((255, 255, 0), 1)):
        if marks.box is not None:
            low, high = drawn(marks.box)
            cv2.rectangle(picture, low, high, color, width)
        for at in drawn(marks.at or ()):
            cv2.drawMarker(picture, at, color, cv2.MARKER_CROSS, 9, width)
    out.mkdir(parents=True, exist_ok=True)
    Workdir(out, "an edit").write_picture(MARKED, picture)


def mask_by_words(
    marks: Marks, camera: Camera, image: npt.NDArray[Any], out: Path, device: str
) -> Mask:
    """Mask a view by words, (H, W) bool, cached in the folder ``words``, since a network may take a
    minute and GPUs may differ in bits. Words, segmenter and picture determine the cache file."""
    assert marks.words is not None
    plain = re.sub(r"[^a-z0-9]+", "-", marks.words.lower()).strip("-")[:24] or "mask"
    of = digest([marks.words, marks.segmenter, digest(image)])[:8]
    files, name = Workdir(out, "an edit"), f"words/{plain}-{of}.png"
    if not files.has(name):
        segmenter = load_segmenter(marks.segmenter, device=device)
        mask = segments_of(segmenter, marks.words, [camera.name])(0, to_float(image))
        (out / "words").mkdir(parents=True, exist_ok=True)
        files.write_picture(name, mask_picture(torch.from_numpy(mask)))
    return np.asarray(files.read_picture(name)[..., 0] > 127)


def lifted_segments(
    mask: Mask,
    splats: Gaussians,
    views: Views,
    source: int,
    report: Reporter,
) -> list[Segment]:
    """Lift the source's mask through splats into all views, (H, W) in [0, 1] each.

    Values are multiples of 1/255, as in mask pictures.
    """
    kept = [views.masks[source]]
    lifted = lift_masks(splats, [views.cameras[source]], [mask], kept=kept)
    (agreement,) = lifted.agreement
    left_out = int((~lifted.reached).sum())
    alone = f", {left_out} of them left out, as they have none" if left_out else ""
    report.log(
        f"lifted through the splats: the source sees {lifted.seen.mean():.0%} of them, the rest"
        f" follow their neighbours{alone}; back in the source the mask"
        f" overlaps itself by {agreement:.0%}"
    )
    if agreement < POOR:
        warnings.warn(
            "the splats do not fit the mask well, so other things may be edited; look at segments/",
            InputWarning,
            stacklevel=2,
        )
    # The soft edge lies inside, so that pixels marked less than half do not change.
    soft = (np.clip(4 * lifted.render(camera) - 2, 0, 1) for camera in views.cameras)
    return [np.rint(255 * share).astype(np.float32) / np.float32(255) for share in soft]


def read_mask(
    path: Path, camera: Camera, beside: Path | None = None, option: str = "--masks"
) -> npt.NDArray[np.bool_]:
    """Read a mask, (H, W) bool: True for white and opaque pixels.

    Args:
        beside: picture of the view; see :func:`attnwarp.io.read_upright`.
        option: name of the option, for errors.
    """
    import cv2

    bright = bright_of(path, beside, option)
    size = (camera.width, camera.height)
    check_view_aspect(bright.shape, camera, f"{option}: {path}")
    if bright.shape != size[::-1]:
        bright = cv2.resize(bright, size, interpolation=cv2.INTER_AREA)
    return np.asarray(bright > 0.5)


def bright_of(path: Path, beside: Path | None, option: str) -> npt.NDArray[Any]:
    """Read the brightness of a grey picture, (H, W) in [0, 1]; transparent pixels are black."""
    pixels, top = read_over_black(path, beside)
    if np.ptp(pixels, axis=-1).max() > COLORED * top:
        raise InputError(
            f"{option}: {path} is coloured, expected a grey picture: white is edited, black is not"
        )
    if pixels.max() == 1:
        raise InputError(
            f"{option}: {path} has no value above 1 of {top}, so all of it is black; multiply its"
            f" values by {top}"
        )
    return np.asarray(pixels.mean(axis=-1) / top)


def read_over_black(path: Path, beside: Path | None = None) -> tuple[npt.NDArray[Any], int]:
    """Read a picture (H, W, 3), composited over black, and the value of white.

    The EXIF orientation is applied; see :func:`attnwarp.io.read_upright` for ``beside``.
    """
    pixels = read_upright(path, beside=beside)
    top = int(np.iinfo(pixels.dtype).max)
    if pixels.shape[2] == 3:
        return pixels, top
    return pixels[..., :3] * (pixels[..., 3:] / top), top
