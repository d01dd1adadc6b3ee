"""Masks by words: the edited part, named in words instead of drawn.

``GroundedSam`` detects boxes with Grounding DINO and outlines them with SAM, both from local
folders. ``ClipSegmenter`` needs no download: it scores regions of the picture with
clip-parts.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from attnwarp.encoders import load_encoder
from attnwarp.encoders.base import PlaceEncoder, checked_image
from attnwarp.errors import InputError, InputWarning, optional_imports

Image = npt.NDArray[Any]
"""(H, W, 3) sRGB, floating, in [0, 1]."""
Mask = npt.NDArray[np.bool_]
"""(H, W)."""

WORKING_SIDE = 256
"""Largest short side in px at which a picture is segmented."""

LONGEST_SIDE = 1024
"""Longest side in px at which a picture is scored and segmented, since a panorama would take
unbounded memory. Pictures up to 4:1 stay below this limit.
"""


@runtime_checkable
class Segmenter(Protocol):
    """Function from a picture and words to a mask.

    Example:
        >>> isinstance(ClipSegmenter.bundled(), Segmenter)
        True
    """

    def segment(self, image: Image, words: str) -> Mask:
        """Segment the object named by the words, (H, W) bool.

        Args:
            image: (H, W, 3) sRGB, floating, in [0, 1].
            words: a noun with or without attributes, such as "bear" or "red mug".
        """
        ...


class NoDetectionError(InputError):
    """Error for a picture in which a segmenter detects no object named by the words."""

    def __init__(self, words: str, view: str | None = None) -> None:
        place = "the picture" if view is None else f"view {view}"
        instead = "" if view is None else ", or give masks instead (--masks)"
        super().__init__(f"no {words!r} was detected in {place}; use other words{instead}")
        self.words = words
        self.view = view


def segments_of(
    segmenter: Segmenter, words: str, names: Sequence[str]
) -> Callable[[int, Image], Mask]:
    """Return a function from a view's number and picture to its mask, as methods take it.

    Raises:
        NoDetectionError: raised by the function; the message names the words and the view.

    Example:
        >>> class Bright:  # a segmenter of one's own
        ...     def segment(self, image, words):
        ...         return image.mean(-1) > 0.5
        >>> masks = segments_of(Bright(), "snow", ["view0"])
        >>> masks(0, np.linspace(0, 1, 12, dtype=np.float32).reshape(2, 2, 3)).tolist()
        [[False, False], [True, True]]
    """

    def segment(index: int, image: Image) -> Mask:
        try:
            return segmenter.segment(image, words)
        except NoDetectionError:
            raise NoDetectionError(words, names[index]) from None

    return segment


def load_segmenter(name: str, *, device: str = "cpu") -> Segmenter:
    """Load a segmenter by name.

    Args:
        name: "clip-parts", or "DINO_FOLDER,SAM_FOLDER" of transformers' models.

    Raises:
        InputError: the segmenter is unknown, or files are missing; the message names them.

    Example:
        >>> type(load_segmenter("clip-parts")).__name__
        'ClipSegmenter'
    """
    folders = segmenter_folders(name)
    if folders is None:
        return ClipSegmenter.bundled()
    return GroundedSam.from_folders(*folders, device=device)


def segmenter_folders(name: str) -> tuple[Path, Path] | None:
    """Parse the Grounding DINO and SAM folders from a segmenter's name; None for clip-parts."""
    if name == "clip-parts":
        return None
    folders = [Path(folder.strip()) for folder in name.split(",") if folder.strip()]
    if len(folders) != 2:
        raise InputError(
            f"segmenter {name!r}: unknown, expected clip-parts, or DINO_FOLDER,SAM_FOLDER"
        )
    _check_folders(*folders)
    return folders[0], folders[1]


def _check_folders(dino: Path, sam: Path) -> None:
    _check_folder(dino, "grounding-dino", ("tokenizer.json", "vocab.txt"))
    _check_folder(sam, "sam", ())


@dataclass(frozen=True, eq=False)
class GroundedSam:
    """Segmenter that outlines Grounding DINO's boxes with SAM and unites each box's best mask.

    Args:
        box_threshold: lower bound of a box's best score, in [0, 1].
        text_threshold: lower bound of the scores that label a box, in [0, 1]. A box labelled by no
            word of the text, only by punctuation, is dropped.
    """

    detector: Any
    detector_processor: Any
    sam: Any
    sam_processor: Any
    box_threshold: float = 0.35
    text_threshold: float = 0.25

    def __post_init__(self) -> None:
        for name in ("box_threshold", "text_threshold"):
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise ValueError(f"{name}: got {value}, expected a number in [0, 1]")

    @classmethod
    def from_folders(
        cls, dino: Path, sam: Path, *, device: str = "cpu", **thresholds: float
    ) -> GroundedSam:
        """Load both models from local folders in transformers' format; nothing is downloaded.

        Args:
            dino: folder such as IDEA-Research/grounding-dino-tiny: config.json, model.safetensors,
                preprocessor_config.json, and tokenizer.json or vocab.txt.
            sam: folder such as facebook/sam-vit-base: config.json, model.safetensors and
                preprocessor_config.json.
        """
        from attnwarp.devices import device_of

        torch_device = str(device_of(device))
        _check_folders(Path(dino), Path(sam))
        with optional_imports():
            from transformers import (
                AutoProcessor,
                GroundingDinoForObjectDetection,
                SamModel,
                SamProcessor,
            )
        import torch

        from attnwarp.editing.folder import load_network, readable

        parts = []
        for folder, network, processor in (
            (Path(dino), GroundingDinoForObjectDetection, AutoProcessor),
            (Path(sam), SamModel, SamProcessor),
        ):
            loaded = load_network(network, folder, torch_device, torch.float32)
            parts.append(loaded.eval().requires_grad_(False))
            with readable(folder):
                parts.append(processor.from_pretrained(folder, local_files_only=True))
        return cls(*parts, **thresholds)

    def segment(self, image: Image, words: str) -> Mask:
        """Segment by words, see :meth:`Segmenter.segment`. A period separates several objects:
        "bear. mug".
        """
        import torch

        pixels = np.rint(255 * checked_image(image)).astype(np.uint8)
        text = _checked_words(words)
        with torch.inference_mode():
            boxes = self._boxes(pixels, text)
            if not len(boxes):
                raise NoDetectionError(text)
            mask = self._outline(pixels, boxes)
        if not mask.any():
            raise NoDetectionError(text)
        return mask

    def _boxes(self, pixels: npt.NDArray[np.uint8], text: str) -> Any:
        """Detect boxes, (N, 4) x0, y0, x1, y1 in px."""
        # Grounding DINO was trained on lower-case phrases that end with a period.
        prompt = text.lower() if text.endswith(".") else f"{text.lower()}."
        processor = self.detector_processor
        inputs = processor(images=pixels, text=prompt, return_tensors="pt").to(self.detector.device)
        result = processor.post_process_grounded_object_detection(
            self.detector(**inputs),
            inputs["input_ids"],
            threshold=self.box_threshold,
            text_threshold=self.text_threshold,
            target_sizes=[pixels.shape[:2]],
        )[0]
        marks = {".", *processor.tokenizer.all_special_tokens}
        named = [
            any(token not in marks for token in label.replace(".", " . ").split())
            for label in result["text_labels"]
        ]
        boxes = result["boxes"].cpu()
        # Without a box, transformers still returns one empty label.
        return boxes[np.array(named[: len(boxes)], dtype=bool)]

    def _outline(self, pixels: npt.NDArray[np.uint8], boxes: Any) -> Mask:
        """Unite the masks, (H, W), that SAM scores best for each box."""
        inputs = self.sam_processor(pixels, input_boxes=[boxes.tolist()], return_tensors="pt")
        device = self.sam.device
        output = self.sam(
            pixel_values=inputs["pixel_values"].to(device),
            input_boxes=inputs["input_boxes"].float().to(device),
        )
        masks = self.sam_processor.post_process_masks(
            output.pred_masks.cpu(), inputs["original_sizes"], inputs["reshaped_input_sizes"]
        )[0]
        best = output.iou_scores[0].argmax(dim=-1).tolist()
        return np.logical_or.reduce([masks[i, k].numpy() for i, k in enumerate(best)])


def _check_folder(folder: Path, model_type: str, tokenizers: tuple[str, ...]) -> None:
    """Raise InputError if a transformers folder lacks files; the message names them."""
    from attnwarp.encoders.preprocess import read_json

    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; expected a {model_type} model of transformers")
    wanted = [
        ("config.json",),
        (
            "model.safetensors", "pytorch_model.bin", "model.safetensors.index.json",
            "pytorch_model.bin.index.json",
        ),
        ("preprocessor_config.json", "processor_config.json"),
        *([tokenizers] if tokenizers else []),
    ]  # fmt: skip
    missing = [names[0] for names in wanted if not any((folder / n).is_file() for n in names)]
    if missing:
        raise InputError(
            f"{folder}: lacks {', '.join(missing)}; fetch the {model_type} model again in"
            " transformers' format"
        )
    actual = read_json(folder / "config.json").get("model_type")
    if actual != model_type:
        raise InputError(
            f"{folder}: config.json is of model_type {actual!r}, expected {model_type!r}"
        )


def _checked_words(words: str) -> str:
    text = words.strip()
    if not any(character.isalnum() for character in text):
        raise InputError(f"words: got {words!r}, expected a name such as 'bear'")
    return text


@dataclass(frozen=True, eq=False)
class ClipSegmenter:
    """Segmenter that scores regions by a text and image encoder and cuts along colours by grabCut.

    A pixel's probability is the mean of the encoder's scores of its surroundings, over several
    sizes of the picture. OpenCV's grabCut (Rother, Kolmogorov, Blake 2004) starts from the probable
    pixels. The constants come from training worlds that the encoder did not learn from. The overlap
    with exact masks is in reports/editor/segments.md. Inspect the masks before using them.

    Args:
        likely: lower bound of the probability of initial foreground pixels.
        background: probability below which a pixel never joins the mask.
        sure: probability from which a pixel always stays in the mask. If none reaches it, a warning
            says that the words are hardly recognised.
        detection: lower bound of the best pixel's probability, in [0, 1].

    Example:
        >>> import numpy as np
        >>> ClipSegmenter.bundled().relevance(np.zeros((48, 64, 3)), "red mug").shape
        (48, 64)
    """

    encoder: PlaceEncoder
    sides: Sequence[int] = (128, 192, 256)
    likely: float = 0.3
    background: float = 0.1
    sure: float = 0.6
    detection: float = 0.3

    @classmethod
    def bundled(cls) -> ClipSegmenter:
        """Build the segmenter with clip-parts."""
        encoder = load_encoder("clip-parts", "clip")
        assert isinstance(encoder, PlaceEncoder)
        return cls(encoder)

    def segment(self, image: Image, words: str) -> Mask:
        """Segment by words, see :meth:`Segmenter.segment`."""
        import cv2

        picture: Image = checked_image(image)
        text = _checked_words(words)
        height, width = picture.shape[:2]
        picture = _resized(picture, min(WORKING_SIDE, height, width))
        probability = self.relevance(picture, text)
        if probability.max() < self.detection:
            raise NoDetectionError(text)
        mask = self._cut(picture, probability)
        if not mask.any():
            raise NoDetectionError(text)
        if (best := probability.max()) < self.sure:
            warnings.warn(
                f"{text!r} is hardly recognised: {best:.0%} likely at best, {self.sure:.0%} is"
                " sure; if what is marked is something else, mark the thing itself (--at X,Y)",
                InputWarning,
                stacklevel=2,
            )
        if mask.shape != (height, width):
            share = cv2.resize(mask.astype(np.float32), (width, height))
            mask = np.asarray(share > 0.5)
        return mask

    def relevance(self, image: Image, words: str) -> npt.NDArray[np.float64]:
        """Estimate the probability that the words describe each pixel, (H, W) in [0, 1]."""
        import cv2

        picture: Image = checked_image(image)
        text = _checked_words(words).removesuffix(".")
        height, width = picture.shape[:2]
        total = np.zeros((height, width))
        for side in self.sides:
            shown = self.encoder.shown(_resized(picture, side), [f"a photo of {text}"])[..., 0]
            total += cv2.resize(shown, (width, height), interpolation=cv2.INTER_LINEAR)
        return total / len(self.sides)

    def _cut(self, picture: Image, probability: npt.NDArray[np.float64]) -> Mask:
        """Snap the mask of probable pixels, (H, W), to borders of colour."""
        likely, possible = probability >= self.likely, probability >= self.background
        # grabCut needs pixels of both foreground and background.
        if likely.all() or not likely.any():
            return likely
        pixels = np.rint(255 * picture).astype(np.uint8)
        return _grab_cut(pixels, possible, likely & possible, probability >= self.sure)


def _resized(picture: Image, short: int) -> Image:
    """Resize a picture to a short side in px, or to a long side of :data:`LONGEST_SIDE`."""
    import cv2

    height, width = picture.shape[:2]
    scale = min(short / min(height, width), LONGEST_SIDE / max(height, width))
    if scale == 1:
        return picture
    size = (max(1, round(scale * width)), max(1, round(scale * height)))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.clip(cv2.resize(picture, size, interpolation=way), 0, 1)


def _grab_cut(pixels: npt.NDArray[np.uint8], possible: Mask, likely: Mask, sure: Mask) -> Mask:
    """Compute the (H, W) foreground in five rounds; what is not even possible stays outside."""
    import cv2

    result = np.where(possible, cv2.GC_PR_BGD, cv2.GC_BGD).astype(np.uint8)
    result[likely] = cv2.GC_PR_FGD
    result[sure] = cv2.GC_FGD
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.setRNGSeed(0)  # seeds grabCut's k-means
    cv2.grabCut(pixels, result, (0, 0, 0, 0), *models, 5, cv2.GC_INIT_WITH_MASK)
    return np.isin(result, (cv2.GC_FGD, cv2.GC_PR_FGD))


RADII = tuple(0.05 * 1.2**step for step in range(13))
"""Radii tried around a click, as shares of the picture's diagonal."""

CLICKED, NEAR = 0.25, 0.7
"""Shares of a radius: sure foreground, and initial foreground."""

GROWN = 1.5
"""Smallest area of a cut over its sure foreground; a smaller cut found no object."""

CORE, WITHIN = 0.5, 0.9
"""Shares of a box's half axes: sure foreground, and initial foreground."""


BAND = 0.0125
"""Distance over the longest side within which an outline moves to an edge of colour."""


def cut_out(
    image: Image,
    *,
    box: Sequence[float] | None = None,
    at: Sequence[float] | None = None,
) -> Mask:
    """Cut out an object marked by a box or a click, by OpenCV's grabCut, (H, W) bool.

    A box gives the object's size, a click does not: grabCut runs with a series of radii, and the
    chosen result, restricted to the part around the click, is the one most similar to the results
    of the next smaller and next larger radius. Boxes are more reliable.

    Args:
        box: x0, y0, x1, y1 in px around the object; everything outside is background.
        at: x, y in px of a point on the object, ideally its middle.

    Raises:
        InputError: neither or both given, a mark outside, an empty box, or nothing found.

    Example:
        >>> import numpy as np
        >>> from attnwarp.editing.segment import cut_out
        >>> picture = np.full((60, 80, 3), 0.2, np.float32)
        >>> picture[20:40, 30:60] = (0.8, 0.1, 0.1)
        >>> mask = cut_out(picture, box=(26, 16, 64, 44))
        >>> bool(mask[30, 45]), bool(mask[10, 10])
        (True, False)
        >>> bool((cut_out(picture, at=(45, 30)) == mask).all())
        True
    """
    import cv2

    picture: Image = checked_image(image)
    height, width = picture.shape[:2]
    if (box is None) == (at is None):
        raise InputError("cut_out: expected either a box or a point")
    check_marks(width, height, box=box, at=at)
    marks = [*(box or ()), *(at or ())]
    limits = [width, height] * (len(marks) // 2)
    small = _resized(picture, min(WORKING_SIDE, height, width))
    h, w = small.shape[:2]
    pixels = np.rint(255 * small).astype(np.uint8)
    x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    a, *rest = (v * side / full for v, side, full in zip(marks, [w, h] * 2, limits, strict=False))
    if at is None:
        # On the bundled scenes boxes do better in Lab, clicks in RGB.
        lab = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2LAB), np.uint8)
        mask = _cut_box(lab, x, y, (a, *rest))
    else:
        mask = _cut_click(pixels, x, y, (min(a, w - 0.5), min(rest[0], h - 0.5)))
    if mask.shape != (height, width):
        mask = np.asarray(cv2.resize(mask.astype(np.float32), (width, height)) > 0.5)
    if not mask.any():
        name, other = (
            ("--box", "a larger box") if at is None else ("--at", "another point, or a box (--box)")
        )
        raise InputError(f"{name}: nothing stands out there by its colours; try {other}")
    return mask


def snap(image: Image, region: Mask) -> Mask:
    """Move a region's outline to edges of colour near it, by OpenCV's grabCut, (H, W) bool.

    Example:
        >>> import numpy as np
        >>> from attnwarp.editing.segment import snap
        >>> picture = np.full((60, 80, 3), 0.2, np.float32)
        >>> picture[20:40, 30:60] = (0.8, 0.1, 0.1)
        >>> rough = np.zeros((60, 80), bool)
        >>> rough[21:40, 31:61] = True
        >>> bool((snap(picture, rough) == (picture[..., 0] > 0.5)).all())
        True
    """
    import cv2

    side = 2 * max(1, round(BAND * max(region.shape))) + 1
    square, inside = np.ones((side, side), np.uint8), region.astype(np.uint8)
    core = cv2.erode(inside, square, borderType=cv2.BORDER_REPLICATE) > 0
    # grabCut needs pixels of both kinds, and a thin region is all outline.
    if not core.any() or region.all():
        return region
    pixels = np.rint(255 * image).astype(np.uint8)
    return _grab_cut(pixels, cv2.dilate(inside, square) > 0, region, core)


def check_marks(
    width: int,
    height: int,
    *,
    box: Sequence[float] | None = None,
    at: Sequence[float] | None = None,
) -> None:
    """Refuse a box or a point outside a picture, and a box without area."""
    for name, marks in (("--box", box), ("--at", at)):
        limits = [width, height] * (len(marks or ()) // 2)
        if not all(0 <= v <= limit for v, limit in zip(marks or (), limits, strict=True)):
            raise InputError(
                f"{name}: got {_typed(marks)}, expected px inside the picture of {width} x {height}"
            )
    if box is not None and (box[2] <= box[0] or box[3] <= box[1]):
        raise InputError(f"--box: got {_typed(box)}, expected X0,Y0,X1,Y1 with X0 < X1 and Y0 < Y1")


def _typed(marks: Sequence[float] | None) -> str:
    return ",".join(f"{v:g}" for v in marks or ())


def _cut_box(
    pixels: npt.NDArray[np.uint8],
    x: npt.NDArray[Any],
    y: npt.NDArray[Any],
    box: Sequence[float],
) -> Mask:
    x0, y0, x1, y1 = box
    within = (x0 <= x) & (x <= x1) & (y0 <= y) & (y <= y1)
    middle, half = ((x0 + x1) / 2, (y0 + y1) / 2), ((x1 - x0) / 2, (y1 - y0) / 2)
    away = np.hypot((x - middle[0]) / half[0], (y - middle[1]) / half[1])
    if within.all():  # grabCut needs background pixels too
        within = away < 1
    likely = within & (away < WITHIN)
    if within.all() or not likely.any():
        return np.zeros_like(within)
    return _grab_cut(pixels, within, likely, within & (away < CORE)) & within


def _cut_click(
    pixels: npt.NDArray[np.uint8],
    x: npt.NDArray[Any],
    y: npt.NDArray[Any],
    at: Sequence[float],
) -> Mask:
    import cv2

    away = np.hypot(x - at[0], y - at[1]) / np.hypot(*pixels.shape[:2])
    cuts, grown = [], []
    for reach in RADII:
        possible, sure = away < reach, away < max(CLICKED * reach, away.min() + 1e-9)
        if (possible | sure).all():
            break
        mask = _grab_cut(pixels, possible, away < NEAR * reach, sure)
        parts = cv2.connectedComponents(mask.astype(np.uint8))[1]
        part = parts[int(at[1]), int(at[0])]
        cuts.append((parts == part) & mask)
        grown.append(cuts[-1].sum() > GROWN * sure.sum())

    def alike(a: Mask, b: Mask) -> float:
        return float((a & b).sum() / max(1, (a | b).sum()))

    if len(cuts) < 3:  # tiny picture
        return np.zeros(away.shape, bool)
    steps = [alike(a, b) for a, b in pairwise(cuts)]
    steadiness = [min(a, b) * big for (a, b), big in zip(pairwise(steps), grown[1:], strict=False)]
    return cuts[1 + int(np.argmax(steadiness))] & (max(steadiness) > 0)
