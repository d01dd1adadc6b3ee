"""Captures of a manifest as inputs of methods: pictures, cameras, splats, segments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from attnwarp.cli.files import check_seen, likeness
from attnwarp.command.edit import marked, view_of
from attnwarp.command.marks import Marks
from attnwarp.digest import digest
from attnwarp.errors import InputError
from attnwarp.fit import Views, load_views
from attnwarp.gaussians import Gaussians
from attnwarp.io import Dataset, read_dataset, read_ply
from attnwarp.methods.pictures import Segment
from attnwarp.reporting import SILENT, Reporter
from attnwarp_lab.captures.manifest import Loaded, MaskPart

LEAST_PSNR = 15.0
"""dB below which renders of splats show another scene than the pictures."""

MARKS, FITS, ORIGINALS = "marks", "fits", "originals"
"""Folders of a run: masks from words, fits by the capture's name, pictures."""


@dataclass(frozen=True, eq=False)
class Ready:
    """A loaded capture.

    Attributes:
        dataset: views of the capture.
        views: pictures and cameras at the manifest's size.
        source: number of the source view.
        content: SHA-256 of the pictures, the cameras and their names, and the source's number.
    """

    dataset: Dataset
    views: Views
    source: int
    content: str


def ready(loaded: Loaded, name: str) -> Ready:
    """Read a capture; each process caches the last one.

    Raises:
        InputError: the capture cannot be used; the message begins with its key in the manifest.
    """
    c = loaded.manifest.captures[name]
    images = None if c.images is None else loaded.path(c.images)
    try:
        return _read(loaded.path(c.data), images, c.scale, loaded.manifest.max_size, c.source)
    except (InputError, FileNotFoundError, ValueError) as error:
        text = str(error).replace("--source", "source")
        raise InputError(f"captures.{name}: {text}") from None


@lru_cache(maxsize=1)
def _read(
    data: Path, images: Path | None, scale: int, max_size: int | None, source: str | None
) -> Ready:
    dataset = read_dataset(data, images=images, scale=scale)
    views = load_views(dataset, max_size=max_size)
    index = view_of(dataset, source)
    content = digest([views.digest, [camera.name for camera in views.cameras], index])
    return Ready(dataset, views, index, content)


def check_likeness(place: str, path: Path, capture: Ready, splats: Gaussians) -> None:
    """Refuse splats that no view sees, or whose renders differ from the pictures.

    Raises:
        InputError: the PSNR is below :data:`LEAST_PSNR`; the message begins with ``place``.
    """
    check_seen(path, splats, capture.views.cameras, SILENT)
    psnr, _ = likeness(splats, capture.dataset)
    if psnr < LEAST_PSNR:
        raise InputError(
            f"{place}: renders of its splats are {psnr:.1f} dB from the pictures, expected at least"
            f" {LEAST_PSNR:g}; give splats that were fitted to these cameras, in the same"
            " coordinates and units (nerfstudio and gsplat turn, move and scale a scene first), or"
            " leave them out, so that they are fitted"
        )


def read_splats(path: Path, kind: str) -> Gaussians:
    """Read splats from a file.

    Raises:
        InputError: no such file, or splats of another kind.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; fit it with attnwarp fit, or leave the key out")
    splats = read_ply(path)
    if splats.kind != kind:
        raise InputError(f"{path}: holds {splats.kind}gs, expected {kind}gs; name another file")
    return splats


def marks_of(loaded: Loaded, name: str) -> Marks:
    """Marks of a capture.

    Raises:
        InputError: several kinds of marks at once.
    """
    part = loaded.manifest.captures[name].mask or MaskPart()
    folder, source = (p and loaded.path(p) for p in (part.folder, part.source))
    return Marks(folder or None, source or None, part.box, part.at, part.words, part.segmenter)


def segments(
    loaded: Loaded, name: str, run: Path, device: str, report: Reporter
) -> Callable[[Gaussians], list[Segment] | None]:
    """(H, W) edited shares of each view, as a function of the splats, None for a capture without
    marks; marks are read, and words searched for, at once.

    Raises:
        InputError: marks that are missing, lie outside the picture, or find nothing.
    """
    capture, marks = ready(loaded, name), marks_of(loaded, name)
    return marked(
        marks, "", capture.dataset, capture.views, capture.source,
        run / MARKS / name, device, report,
    )  # fmt: skip
