"""Reading of pictures, the only entry point, so that truncated files are refused everywhere.

Pillow reads the pixels of 8 bits, and OpenCV those of 16, which Pillow cuts to 8.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp import check
from attnwarp.io.file import FileFormatError, existing_file

IMAGE_SUFFIXES = (
    ".png",
    ".jpg",
    ".jpeg",
    ".PNG",
    ".JPG",
    ".JPEG",
    ".webp",
    ".tif",
    ".tiff",
    ".exr",
)
"""Suffixes of images, in search order."""


def image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Read (width, height) in px from a picture's header, without decoding it.

    The size refers to stored pixels: EXIF orientation is ignored.

    Args:
        path: path of a picture in any format of Pillow or OpenCV.

    Raises:
        FileNotFoundError: the file does not exist.
        FileFormatError: the file is not a picture, or exceeds Pillow's size limit.

    Example:
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from attnwarp.io import image_size
        >>> from attnwarp.io.images import encode_png
        >>> _ = Path("image.png").write_bytes(encode_png(np.zeros((2, 3, 3), np.uint8)))
        >>> image_size("image.png")
        (3, 2)
    """
    path = existing_file(path)
    size: tuple[int, int] | None = _with_pillow(path, lambda image: image.size)
    if size is None:
        height, width = read_image(path).shape[:2]
        return width, height
    return size


def orientation(path: str | os.PathLike[str]) -> int:
    """Read the EXIF orientation of a picture, 1 to 8; 1 means no rotation.

    An unreadable tag counts as 1.

    Example:
        >>> from PIL import Image
        >>> picture = Image.new("RGB", (4, 3))
        >>> exif = picture.getexif()
        >>> exif[274] = 6
        >>> picture.save("turned.jpg", exif=exif)
        >>> orientation("turned.jpg"), image_size("turned.jpg")
        (6, (4, 3))
    """

    def asked(image: Any) -> Any:
        # A damaged tag can raise any exception in Pillow.
        with contextlib.suppress(Exception):
            return image.getexif().get(_ORIENTATION, 1)
        return 1

    turn: Any = _with_pillow(existing_file(path), asked)
    return int(turn) if turn in range(1, 9) else 1


def upright_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Compute (width, height) in px of the result of :func:`read_upright`."""
    width, height = image_size(path)
    return (height, width) if orientation(path) >= 5 else (width, height)


def read_upright(
    path: str | os.PathLike[str], *, beside: str | os.PathLike[str] | None = None
) -> npt.NDArray[Any]:
    """Read a picture as viewers show it: rotated or mirrored by its EXIF tag.

    Args:
        path: path of the picture, see :func:`read_image`.
        beside: path of the posed picture that this one belongs to. A posed picture's pixels are
            used as stored, so a tag present in both is ignored in both.

    Returns:
        (H, W, 3) or (H, W, 4) as in :func:`read_image`.

    Example:
        >>> from PIL import Image
        >>> from attnwarp.io import read_image, read_upright
        >>> picture = Image.new("RGB", (4, 3))
        >>> exif = picture.getexif()
        >>> exif[274] = 6
        >>> picture.save("turned.jpg", exif=exif)
        >>> read_image("turned.jpg").shape, read_upright("turned.jpg").shape
        ((3, 4, 3), (4, 3, 3))
    """
    stored = read_image(path)
    turn = orientation(path)
    if turn == 1 or (beside is not None and orientation(beside) == turn):
        return stored
    if turn >= 5:
        stored = stored.swapaxes(0, 1)
    return np.ascontiguousarray(np.flip(stored, _FLIPS.get(turn, ())))


def read_image(path: str | os.PathLike[str]) -> npt.NDArray[Any]:
    """Read a picture, (H, W, 3) or (H, W, 4) sRGB, in the file's depth and stored orientation.

    Grey becomes three equal channels. A camera's pose refers to the stored pixels, so an EXIF
    rotation is not applied; :func:`read_upright` applies it.

    Args:
        path: picture of 8 or 16 bits a channel: PNG, JPEG, TIFF, WebP. A JPEG has no checksum, so
            that damage inside it is visible in the picture alone.

    Returns:
        uint8 or uint16; a fourth channel is straight (not premultiplied) alpha.

    Raises:
        FileNotFoundError: the file does not exist.
        FileFormatError: the file is not a picture, is truncated, has neither 8 nor 16 bits, asks to
            be turned and is a TIFF, or exceeds Pillow's size limit (about 179 million px).

    Example:
        >>> from attnwarp.io import read_image
        >>> from PIL import Image
        >>> Image.new("RGB", (4, 3), (255, 0, 0)).save("red.png")
        >>> read_image("red.png").shape, read_image("red.png")[0, 0].tolist()
        ((3, 4, 3), [255, 0, 0])
    """
    import cv2

    path = existing_file(path)
    pixels: npt.NDArray[Any] | None = _with_pillow(path, _pixels)
    if pixels is not None:
        return pixels
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    # Never by path: OpenCV crashes on a name that is not UTF-8.
    image = cv2.imdecode(np.fromfile(path, np.uint8), flags)
    if image is None:
        raise FileFormatError(path, "cannot be read as an image; replace it or leave it out")
    if image.dtype not in (np.uint8, np.uint16):
        raise FileFormatError(
            path, f"holds {image.dtype}, expected 8 or 16 bits a channel of sRGB; convert it to PNG"
        )
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, axis=2)
    code = cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(image, code))


def read_mask(path: str | os.PathLike[str], height: int, width: int) -> npt.NDArray[np.bool_]:
    """Read a mask, (height, width) bool: False where it is dark, below half of white.

    A smaller mask pixel is True if all that it covers is.
    """
    import cv2

    image = read_image(path)
    bright = image[..., :3].max(axis=2) >= (np.iinfo(image.dtype).max + 1) // 2
    try:
        check.same_aspect((height, width), bright.shape, str(path), "draw it on its picture")
    except ValueError as error:
        raise FileFormatError(Path(path), str(error).partition(": ")[2]) from None
    shares = cv2.resize(bright.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(shares > 1 - 1e-4)


def encode_png(rgb: npt.NDArray[Any]) -> bytes:
    """Encode a picture as PNG."""
    import cv2

    code = cv2.COLOR_RGBA2BGRA if rgb.shape[2] == 4 else cv2.COLOR_RGB2BGR
    _, data = cv2.imencode(".png", cv2.cvtColor(rgb, code))
    return bytes(data.tobytes())


def weighted_by_alpha(
    image: npt.NDArray[Any], resample: Callable[[npt.NDArray[Any]], npt.NDArray[Any]]
) -> npt.NDArray[Any]:
    """Resample a picture with straight alpha, weighting its colours by alpha.

    The colour of transparent pixels has no meaning and must not bleed into their neighbours.

    Args:
        image: (H, W, 4) uint8 or uint16.
        resample: function from (H, W, 4) float32 in [0, 1] to the new (h, w, 4).

    Returns:
        (h, w, 4) of the same dtype; transparent pixels are black.
    """
    top = float(np.iinfo(image.dtype).max)
    values: npt.NDArray[Any] = image.astype(np.float32) / top
    values[..., :3] *= values[..., 3:]
    values = resample(values)
    values = np.concatenate(
        [values[..., :3] / np.maximum(values[..., 3:], 1e-6), values[..., 3:]], axis=2
    )
    return np.round(np.clip(values, 0, 1) * top).astype(image.dtype)


def _pixels(image: Any) -> npt.NDArray[np.uint8] | None:
    """Decode a picture of 8 bits, (H, W, 3) or (H, W, 4); of a deeper one, which Pillow would cut
    to 8 bits, only see that it is whole.
    """
    deep = image.mode in ("I", "F") or ";16" in str(image.tile)
    image.load()
    mode = "RGBA" if image.mode.endswith("A") or "transparency" in image.info else "RGB"
    if deep:
        return None
    return np.array(image if image.mode == mode else image.convert(mode))


def _with_pillow(path: Path, use: Callable[[Any], Any]) -> Any:
    """Open a picture with Pillow and return ``use`` of it; an error message has one line.

    Formats unknown to Pillow, such as TIFF of 16 bits and three channels, return None.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            # Pillow's warnings of a large picture or an odd tag are ignored.
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                tags = getattr(image, "tag_v2", {}) if image.format == "TIFF" else {}
                if tags.get(_ORIENTATION, 1) != 1:  # Pillow would turn the pixels of this format
                    raise FileFormatError(
                        path, "asks to be turned by a tag; convert it to an upright PNG"
                    )
                return use(image)
    except UnidentifiedImageError:
        return None
    except Image.DecompressionBombError:
        limit = 2 * (Image.MAX_IMAGE_PIXELS or 0)
        raise FileFormatError(
            path, f"the picture has more than {limit:,} px; make it smaller"
        ) from None
    # A damaged byte can raise any exception in Pillow's decoders.
    except (OSError, SyntaxError, ValueError, ArithmeticError, LookupError, TypeError) as error:
        if isinstance(error, FileFormatError) or getattr(error, "errno", None) is not None:
            raise
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise FileFormatError(
            path, f"the picture is damaged ({first}); replace it or leave it out"
        ) from None


_ORIENTATION = 274
"""Tag of the orientation, in EXIF and TIFF."""

_FLIPS = {2: (1,), 3: (0, 1), 4: (0,), 6: (1,), 7: (0, 1), 8: (0,)}
"""Axes to flip by EXIF orientation, after transposing for orientations from 5 on."""
