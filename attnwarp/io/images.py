"""Pictures: the one door through which they come in, so that a damaged one is refused everywhere.

OpenCV reads the pixels, since it keeps 16 bits. It fills what is missing of a JPEG with grey and
returns a picture; Pillow, which refuses such a file, therefore decodes it first.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import struct
import tempfile
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from attnwarp import check
from attnwarp.errors import InputWarning
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
"""Suffixes of images, in the order in which they are looked for."""

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"


def image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """(width, height) in px from a picture's header, without decoding it.

    The size is that of the stored pixels: EXIF orientation is ignored.

    Args:
        path: picture of any format that Pillow or OpenCV reads.

    Raises:
        FileNotFoundError: no such file.
        FileFormatError: not a picture, or larger than Pillow opens.

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
    size: tuple[int, int] | None = _with_pillow(path, lambda image: image.size, _unturned(path))
    if size is None:
        height, width = read_image(path).shape[:2]
        return width, height
    return size


def orientation(path: str | os.PathLike[str]) -> int:
    """EXIF's orientation of a picture, 1 to 8: the turn that viewers show it with; 1 is none.

    A tag that cannot be read turns nothing.

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
        # Pillow raises whatever a damaged tag leads to.
        with contextlib.suppress(Exception):
            return image.getexif().get(_ORIENTATION, 1)
        return 1

    path = existing_file(path)
    tags = _tiff_tags(path)  # Pillow does not open the pixels of all of them
    turn: Any = _with_pillow(path, asked) if tags is None else tags.get(_ORIENTATION)
    return int(turn) if turn in range(1, 9) else 1


def upright_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """(width, height) in px of what :func:`read_upright` reads."""
    width, height = image_size(path)
    return (height, width) if orientation(path) >= 5 else (width, height)


def read_upright(
    path: str | os.PathLike[str],
    *,
    beside: str | os.PathLike[str] | None = None,
    damaged: Literal["warn", "error"] = "warn",
) -> npt.NDArray[Any]:
    """Read a picture as every viewer shows it: turned or mirrored as its EXIF tag asks.

    Args:
        path: see :func:`read_image`.
        beside: the picture of a pose that this one belongs to. Its pixels are taken as stored, so
            a tag that both have is followed in neither.
        damaged: see :func:`read_image`.

    Returns:
        (H, W, 3) or (H, W, 4) as of :func:`read_image`.

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
    stored = read_image(path, damaged=damaged)
    turn = orientation(path)
    if turn == 1 or (beside is not None and orientation(beside) == turn):
        return stored
    if turn >= 5:
        stored = stored.swapaxes(0, 1)
    return np.ascontiguousarray(np.flip(stored, _FLIPS.get(turn, ())))


def read_image(
    path: str | os.PathLike[str], *, damaged: Literal["warn", "error"] = "warn"
) -> npt.NDArray[Any]:
    """(H, W, 3) or (H, W, 4) sRGB of a picture, in the depth and the orientation of the file.

    Grey becomes three equal channels. A camera's pose belongs to the pixels as stored, so an EXIF
    tag that asks for a turn is not followed; :func:`read_upright` follows it.

    Args:
        path: a picture of 8 or 16 bits a channel: PNG, JPEG, TIFF, WebP.
        damaged: "error" to refuse a JPEG of which the decoder complains, as doors that measure do.
            A JPEG has no checksum: some damage shows in the picture alone.

    Returns:
        uint8 or uint16; a fourth channel is straight (not premultiplied) alpha.

    Warns:
        InputWarning: what the decoder complains of in a JPEG, with ``damaged="warn"``.

    Raises:
        FileNotFoundError: no such file.
        FileFormatError: not a picture, one that breaks off or is damaged, one of other than 8 or 16
            bits, or one larger than Pillow opens (about 179 million px).

    Example:
        >>> from attnwarp.io import read_image
        >>> from PIL import Image
        >>> Image.new("RGB", (4, 3), (255, 0, 0)).save("red.png")
        >>> read_image("red.png").shape, read_image("red.png")[0, 0].tolist()
        ((3, 4, 3), [255, 0, 0])
    """
    import cv2

    path = existing_file(path)
    tiff = _unturned(path)
    rgba: npt.NDArray[Any] | None = _with_pillow(path, _alpha_lost_by_opencv, tiff)
    data = path.read_bytes() if tiff is None else tiff
    # Not every decoder looks at the checksum of each part of a PNG, and damage would be pixels.
    if data.startswith(_PNG) and not _with_pillow(path, lambda image: image.verify() or True):
        raise FileFormatError(path, "the picture is damaged; replace it or leave it out")
    if rgba is not None:
        return rgba
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    # Never by its path: OpenCV crashes at a name that is no UTF-8.
    bits = np.frombuffer(data, np.uint8)

    def decode() -> Any:
        return cv2.imdecode(bits, flags) if data else None

    image, complaint = _with_complaint(decode) if data.startswith(_JPEG) else (decode(), "")
    if complaint:
        _report(path, complaint, damaged)
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


def encode_png(rgb: npt.NDArray[Any]) -> bytes:
    """The PNG of a picture.

    Args:
        rgb: (H, W, 3) or (H, W, 4) uint8 or uint16 RGB(A).
    """
    import cv2

    code = cv2.COLOR_RGBA2BGRA if rgb.shape[2] == 4 else cv2.COLOR_RGB2BGR
    _, data = cv2.imencode(".png", cv2.cvtColor(rgb, code))
    return bytes(data.tobytes())


def weighted_by_alpha(
    image: npt.NDArray[Any], resample: Callable[[npt.NDArray[Any]], npt.NDArray[Any]]
) -> npt.NDArray[Any]:
    """A picture with straight alpha, resampled with its colours weighted by alpha.

    The colour of transparent pixels has no meaning and must not bleed into their neighbours.

    Args:
        image: (H, W, 4) uint8 or uint16.
        resample: makes the new (h, w, 4) of (H, W, 4) float32 in [0, 1].

    Returns:
        (h, w, 4) of the same dtype; black where it is transparent.
    """
    top = float(np.iinfo(image.dtype).max)
    values: npt.NDArray[Any] = image.astype(np.float32) / top
    values[..., :3] *= values[..., 3:]
    values = resample(values)
    values = np.concatenate(
        [values[..., :3] / np.maximum(values[..., 3:], 1e-6), values[..., 3:]], axis=2
    )
    return np.round(np.clip(values, 0, 1) * top).astype(image.dtype)


def _with_pillow(path: Path, use: Callable[[Any], Any], data: bytes | None = None) -> Any:
    """Open a picture with Pillow and return ``use`` of it; an error takes one line.

    None for a format that Pillow does not know, such as TIFF of 16 bits and three channels.

    Args:
        path: path of the picture.
        use: called with it.
        data: in place of the file's, if given.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            # A large picture or an odd tag is no reason to stop.
            warnings.simplefilter("ignore")
            with Image.open(path if data is None else io.BytesIO(data)) as image:
                return use(image)
    except UnidentifiedImageError:
        return None
    except Image.DecompressionBombError:
        limit = 2 * (Image.MAX_IMAGE_PIXELS or 0)
        raise FileFormatError(
            path, f"the picture has more than {limit:,} px; make it smaller"
        ) from None
    # Pillow's decoders raise whatever a damaged byte leads to.
    except (OSError, SyntaxError, ValueError, ArithmeticError, LookupError, TypeError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise FileFormatError(
            path, f"the picture is damaged ({first}); replace it or leave it out"
        ) from None


_COMPLAINT = re.compile(rb"^(?:Corrupt JPEG|Premature end|Inconsistent prog|Invalid ).*\n", re.M)
"""Warnings of libjpeg (jerror.h) after which pixels are made up."""

_STDERR = threading.Lock()


def _with_complaint(decode: Callable[[], Any]) -> tuple[Any, str]:
    """The result of ``decode``, and what libjpeg writes of it to the standard error: OpenCV hands
    its warnings on in no other way. All else that is written meanwhile goes there afterwards.
    """
    with _STDERR, tempfile.TemporaryFile() as caught:
        try:
            stderr = os.dup(2)
        except OSError:  # closed
            return decode(), ""
        os.dup2(caught.fileno(), 2)
        try:
            result = decode()
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            caught.seek(0)
            written = caught.read()
            if other := _COMPLAINT.sub(b"", written):
                os.write(2, other)
    found = _COMPLAINT.search(written)
    return result, found[0].decode(errors="replace").strip() if found else ""


def _report(path: Path, complaint: str, damaged: Literal["warn", "error"]) -> None:
    """Warn of a damaged JPEG, or refuse it."""
    message = (
        f"{path}: the picture is damaged (the decoder says: {complaint}), so parts of it may be"
        " wrong; get it again whole or leave it out, or, if it looks right, save it anew"
    )
    check.one_of(damaged, ("warn", "error"), "damaged")
    if damaged == "error":
        raise FileFormatError(path, message.removeprefix(f"{path}: "))
    warnings.warn(message, InputWarning, stacklevel=3)


def _alpha_lost_by_opencv(image: Any) -> npt.NDArray[np.uint8 | np.uint16] | None:
    """Decode a picture; return (H, W, 4) where OpenCV drops its alpha or multiplies it into the
    colours: TIFF of 8 bits, and grey PNG with a transparent value.
    """
    image.load()
    clear = image.info.get("transparency")
    if image.mode in ("I", "I;16") and clear is not None:
        values = np.array(image, np.uint16)
        alpha = np.where(values == clear, 0, 65535).astype(np.uint16)
        return np.stack([values, values, values, alpha], axis=2)
    tiff = image.format == "TIFF" and image.mode in ("LA", "RGBA")
    # Pillow opens 16 bits as 8, and OpenCV reads them right.
    tiff = tiff and max(image.tag_v2.get(_BITS, (8,))) <= 8
    grey = image.mode in ("1", "L") and clear is not None
    return np.array(image.convert("RGBA")) if tiff or grey else None


_ORIENTATION, _BITS, _SAMPLES = 274, 258, 277
"""TIFF's tags that ask for a turn, that hold the bits of each channel, and their number."""

_BIG = 43
"""Number that a BigTIFF has in place of 42."""

_FLIPS = {2: (1,), 3: (0, 1), 4: (0,), 6: (1,), 7: (0, 1), 8: (0,)}
"""Axes to flip by EXIF's orientation, after rows and columns have changed places from 5 on."""


def _tiff_tags(path: Path) -> dict[int, Any] | None:
    """The tags of a TIFF's first picture that concern its reading, and under 0 where its directory
    begins; None for any other file.
    """
    from PIL.TiffImagePlugin import PREFIXES, ImageFileDirectory_v2

    tags: dict[int, Any] = {}
    with path.open("rb") as stream:
        head = stream.read(8)
        if not head.startswith(tuple(PREFIXES)):
            return None
        # What is damaged the decoders find; Pillow raises whatever it leads to.
        with warnings.catch_warnings(), contextlib.suppress(Exception):
            warnings.simplefilter("ignore")
            header = head
            if _BIG in head[2:4]:  # Pillow knows it by a third byte alone, which is II's
                header = b"II" + bytes([_BIG, 0]) + head[4:] + stream.read(8)
            directory = ImageFileDirectory_v2(header, head[:2])
            tags[0] = stream.seek(directory.next)
            directory.load(stream)
            tags |= {t: directory[t] for t in (_ORIENTATION, _SAMPLES) if t in directory}
            tags[_BITS] = int(max(directory[_BITS]))
    return tags


def _unturned(path: Path) -> bytes | None:
    """The bytes of a TIFF whose tag, if it asks for a turn, asks for none: OpenCV and Pillow turn
    the pixels of this format whatever they are told. None for any other file.

    Raises:
        FileFormatError: grey of 16 bits with alpha, which OpenCV reads as 8 bits without alpha.
    """
    tags = _tiff_tags(path)
    if tags is None:
        return None
    if tags.get(_SAMPLES) == 2 and tags.get(_BITS, 8) > 8:
        raise FileFormatError(
            path, "grey of 16 bits with alpha, which cannot be read as TIFF; convert it to PNG"
        )
    data = path.read_bytes()
    if tags.get(_ORIENTATION, 1) not in range(2, 9):
        return data
    order = "<" if data.startswith(b"II") else ">"
    entry = struct.Struct(f"{order}HH{'Q' if _BIG in data[2:4] else 'I'}H")  # and the turn
    turned, upright = (entry.pack(_ORIENTATION, 3, 1, v) for v in (tags[_ORIENTATION], 1))
    return data[: tags[0]] + data[tags[0] :].replace(turned, upright, 1)
