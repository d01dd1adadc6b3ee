"""JSON of the harness: one text for each value, hashes of it, null for NaN."""

from __future__ import annotations

import hashlib
import json
import lzma
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from attnwarp.errors import InputError
from attnwarp.io.text import read_text
from attnwarp_eval.files import write_atomic

T = TypeVar("T")


def canonical_json(value: Any) -> str:
    """The unique JSON text of a value: sorted keys, no spaces, no NaN.

    >>> canonical_json({"b": 1, "a": [2.5, None]})
    '{"a":[2.5,null],"b":1}'
    """
    return json.dumps(
        value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True
    )


def digest(value: Any) -> str:
    """SHA-256 of a value's canonical JSON, as 64 hexadecimal digits."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


def without_nan(value: Any) -> Any:
    """``value`` with null for every number that JSON lacks: NaN and the infinities.

    Mappings and sequences are converted recursively; NumPy's numbers become Python's.

    >>> without_nan({"psnr": float("inf"), "views": [1, np.float64("nan"), "a"]})
    {'psnr': None, 'views': [1, None, 'a']}
    """
    if isinstance(value, Mapping):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: Path, value: Any, *, sort_keys: bool = True, durable: bool = True) -> None:
    """Write ``value`` as readable JSON, atomically.

    Raises:
        ValueError: a number that JSON lacks; see :func:`without_nan`.
    """
    text = json.dumps(value, indent=1, sort_keys=sort_keys, allow_nan=False) + "\n"
    write_atomic(path, text.encode(), durable=durable)


def read_as(kind: type[T], path: Path, remedy: str) -> T:
    """Read a JSON file, or one compressed as ``.xz``, as a model or dataclass of pydantic.

    Args:
        kind: class of the content.
        path: path of the file.
        remedy: advice on a bad file, in words.

    Raises:
        InputError: the file is missing, no JSON, or an entry is missing, unknown or wrong.
    """
    from pydantic import TypeAdapter, ValidationError

    try:
        text = lzma.decompress(path.read_bytes()) if path.suffix == ".xz" else read_text(path)
        return TypeAdapter(kind).validate_json(text)
    except OSError as error:
        why = "is missing" if isinstance(error, FileNotFoundError) else str(error.strerror)
    except UnicodeDecodeError:
        why = "is no text"
    except lzma.LZMAError:
        why = "is no xz file, or cut off"
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the file"
        why = f"{place}: {first['msg']}"
    raise InputError(f"{path}: {why}; {remedy}")
