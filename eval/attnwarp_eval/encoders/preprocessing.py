"""The preprocessing that a folder of published weights names, read from its file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from attnwarp import check
from attnwarp.encoders.preprocess import FILTERS, Preprocessing, read_json
from attnwarp.errors import InputError

CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)

_FILES = ("preprocessor_config.json", "processor_config.json")
_FAMILIES = ("CLIPImageProcessor", "CLIPFeatureExtractor", "BitImageProcessor")


def read_preprocessing(folder: Path) -> Preprocessing:
    """Read preprocessor_config.json, or the corresponding part of processor_config.json, written by
    newer versions.

    Missing keys take CLIP's values: shorter edge to 224 px, bicubic, the central 224 x 224 px,
    CLIP's mean and deviation.
    """
    path = next((folder / name for name in _FILES if (folder / name).is_file()), None)
    if path is None:
        raise InputError(
            f"{folder}: no {' or '.join(_FILES)}; place the one that was published with the weights"
            " there"
        )
    config = read_json(path)
    if path.name == _FILES[1]:
        config = config.get("image_processor") or {}
        if not isinstance(config, dict):
            raise InputError(
                f"{path}: image_processor is {config!r}, expected an object; place the file that"
                " was published with the weights"
            )
    family = (
        config.get("image_processor_type")
        or config.get("feature_extractor_type")
        or "CLIPImageProcessor"
    )
    if str(family).removesuffix("Fast").removesuffix("Pil") not in _FAMILIES:
        raise InputError(
            f"{path}: image_processor_type is {family!r}, expected one of {', '.join(_FAMILIES)}"
        )
    if config.get("do_pad") not in (None, False):
        raise InputError(
            f"{path}: do_pad is set, which is not supported; encoders that pad are not known here"
        )
    try:
        normalise = config.get("do_normalize", True)
        rescale = 1.0
        if config.get("do_rescale", True):
            rescale = float(config.get("rescale_factor", 1 / 255))
        return Preprocessing(
            resize=_size(config.get("size", 224), edge=True)
            if config.get("do_resize", True)
            else None,
            resample=_resample(config.get("resample", 3)),
            crop=_pair(config.get("crop_size", 224))
            if config.get("do_center_crop", True)
            else None,
            # The file's factor is for values of 0 to 255. A rounded 1/255 must give exactly 1.
            scale=1.0 if abs(rescale * 255 - 1) < 1e-6 else rescale * 255,
            mean=_three(config, "image_mean", CLIP_MEAN) if normalise else (0.0, 0.0, 0.0),
            std=_three(config, "image_std", CLIP_STD) if normalise else (1.0, 1.0, 1.0),
        )
    except (TypeError, ValueError, KeyError) as error:
        raise InputError(
            f"{path}: {error}; place the file that was published with the weights"
        ) from None


def _size(value: Any, *, edge: bool) -> int | tuple[int, int]:
    if isinstance(value, dict):
        keys = {key for key, side in value.items() if side is not None}
        if edge and keys == {"shortest_edge"}:
            return _side(value["shortest_edge"])
        if keys == {"height", "width"}:
            return _side(value["height"]), _side(value["width"])
        raise ValueError(
            f"size {value} is not known here, expected shortest_edge, or height and width"
        )
    return _side(value)


def _pair(value: Any) -> tuple[int, int]:
    size = _size(value, edge=False)
    return size if isinstance(size, tuple) else (size, size)


def _side(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"size {value!r} is not a number of px")
    return value


def _resample(value: Any) -> int:
    if isinstance(value, bool) or value not in FILTERS:
        raise ValueError(f"resample {value!r} is not known, expected one of {FILTERS}")
    return int(value)


def _three(config: dict[str, Any], key: str, default: tuple[float, ...]) -> tuple[float, ...]:
    """Read one number for each channel."""
    values = config.get(key, default)
    entries = values if isinstance(values, list | tuple) else [values]
    if len(entries) != 3 or not all(check.is_number(v) for v in entries):
        raise ValueError(f"{key} is {values!r}, expected three numbers")
    return tuple(map(float, entries))
