"""Pictures: the one door through which they come in, so that a damaged one is refused everywhere.

OpenCV reads the pixels, since it keeps 16 bits. It fills what is missing of a JPEG with grey and
returns a picture; Pillow, which refuses such a file, therefore decodes it first.
"""

from __future__ import annotations

import os
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.io.file import FileFormatError, existing_file

_PNG = b"\x89PNG\r\n\x1a\n"


def image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """(width, height) in px from a picture's header, without decoding it.

    The size is that of the stored pixels: EXIF orientation is ignored.

    Args:
        path: of any format that Pillow or OpenCV reads.

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
    size: tuple[int, int] | None = _with_pillow(path, lambda image: image.size)
    if size is None:
        height, width = read_image(path).shape[:2]
        return width, height
    return size


def read_image(path: str | os.PathLike[str]) -> npt.NDArray[Any]:
    """(H, W, 3) or (H, W, 4) sRGB of a picture, in the depth and the orientation of the file.

    Grey becomes three equal channels. A camera's pose belongs to the pixels as stored, so an EXIF
    tag that asks for a turn is not followed.

    Args:
        path: a picture of 8 or 16 bits a channel: PNG, JPEG, TIFF, WebP.

    Returns:
        uint8 or uint16; a fourth channel is straight (not premultiplied) alpha.

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
    rgba: npt.NDArray[np.uint8] | None = _with_pillow(path, _alpha_lost_by_opencv)
    _check_png(path)
    if rgba is not None:
        return rgba
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
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


def _with_pillow(path: Path, use: Callable[[Any], Any]) -> Any:
    """What ``use`` makes of the picture opened by Pillow, with its errors in one line.

    None for a format that Pillow does not know, such as TIFF of 16 bits and three channels.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            # A large picture or an odd tag is no reason to stop.
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
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


def _alpha_lost_by_opencv(image: Any) -> npt.NDArray[np.uint8] | None:
    """Decode a picture; return (H, W, 4) where OpenCV drops its alpha or multiplies it into the
    colours: TIFF of 8 bits, and grey PNG with a transparent value.
    """
    image.load()
    tiff = image.format == "TIFF" and image.mode in ("LA", "RGBA")
    grey = image.mode in ("1", "L") and "transparency" in image.info
    return np.array(image.convert("RGBA")) if tiff or grey else None


def _check_png(path: Path) -> None:
    """Check the CRC of each chunk of a PNG: not every decoder does, and damage would be pixels."""
    data = path.read_bytes()
    if not data.startswith(_PNG):
        return
    start = len(_PNG)
    while start < len(data):
        length = int.from_bytes(data[start : start + 4], "big")
        end = start + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(data[start + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            raise FileFormatError(
                path,
                f"the picture is damaged (checksum of the part at byte {start}); replace it or"
                " leave it out",
            )
        if data[start + 4 : start + 8] == b"IEND":
            return
        start = end + 4
    raise FileFormatError(
        path, "the picture is damaged (it breaks off); replace it or leave it out"
    )
