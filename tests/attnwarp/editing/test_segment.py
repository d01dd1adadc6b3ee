"""Masks by words; oracles are transformers' own processors, and exact masks of a ray-cast world."""

import dataclasses
import re
import shutil

import cv2
import numpy as np
import pytest
import torch
import unseen_worlds
from tiny_segmenters import save_dino, save_sam

from attnwarp.editing.segment import (
    ClipSegmenter,
    GroundedSam,
    NoDetectionError,
    Segmenter,
    cut_out,
    load_segmenter,
    segments_of,
)
from attnwarp.errors import InputError, InputWarning
from training.worlds.editing_pairs import PAIR_SPLITS, THING, edit_looks, edit_world, shown_things
from training.worlds.render import pictures

PIXELS = np.random.default_rng(0).integers(0, 256, (50, 70, 3), dtype=np.uint8)
IMAGE = PIXELS.astype(np.float32) / 255


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    place = tmp_path_factory.mktemp("segmenters")
    return place / "dino", place / "sam", save_dino(place / "dino"), save_sam(place / "sam")


@pytest.mark.parametrize("threshold", [0.0, 0.98, 0.9995])
def test_it_is_transformers_own_models_and_processors_in_turn(folders, threshold):
    dino, sam, (detector, processor), (outliner, outliner_processor) = folders
    with torch.no_grad():
        inputs = processor(images=PIXELS, text="a bear.", return_tensors="pt")
        boxes = processor.post_process_grounded_object_detection(
            detector(**inputs), inputs.input_ids, threshold=threshold, text_threshold=0.25, target_sizes=[(50, 70)]
        )[0]  # fmt: skip
        named = [
            i for i, label in enumerate(boxes["text_labels"]) if "bear" in label or "a" in label
        ]
        expected = np.zeros((50, 70), bool)
        for box in boxes["boxes"][named]:
            inputs = outliner_processor(PIXELS, input_boxes=[[box.tolist()]], return_tensors="pt")
            inputs["input_boxes"] = inputs["input_boxes"].float()
            sizes = inputs["original_sizes"], inputs["reshaped_input_sizes"]
            output = outliner(
                pixel_values=inputs["pixel_values"], input_boxes=inputs["input_boxes"]
            )
            masks = outliner_processor.post_process_masks(output.pred_masks, *sizes)[0]
            expected |= masks[0, output.iou_scores[0, 0].argmax()].numpy()
    segmenter = GroundedSam.from_folders(dino, sam, box_threshold=threshold)
    assert isinstance(segmenter, Segmenter)
    mask = segmenter.segment(IMAGE, "A bear")
    assert mask.dtype == np.bool_
    assert 0 < expected.mean() < 1
    assert len(named) == {0.0: 6, 0.98: 4, 0.9995: 2}[threshold]
    # SAM on all boxes at once rounds in another order than on one.
    assert (mask != expected).mean() < 1e-3


def test_a_threshold_that_no_box_reaches_is_an_error_with_the_words(folders):
    segmenter = GroundedSam.from_folders(*folders[:2], box_threshold=1.0)
    with pytest.raises(NoDetectionError, match="no 'red mug' was detected in the picture") as error:
        segmenter.segment(IMAGE, "red mug")
    assert error.value.words == "red mug"
    masks = segments_of(segmenter, "red mug", ["a.png", "b.png"])
    with pytest.raises(NoDetectionError, match="no 'red mug' was detected in view b.png"):
        masks(1, IMAGE)


@pytest.mark.door
@pytest.mark.parametrize(
    ("model", "file", "message"),
    [
        ("dino", "config.json", "dino: lacks config.json; fetch the grounding-dino model"),
        ("dino", "model.safetensors", "dino: lacks model.safetensors"),
        ("dino", "processor_config.json", "dino: lacks preprocessor_config.json"),
        ("dino", "tokenizer.json", "dino: lacks tokenizer.json"),
        ("sam", "model.safetensors", "sam: lacks model.safetensors; fetch the sam model"),
        ("sam", "processor_config.json", "sam: lacks preprocessor_config.json"),
    ],
)
def test_missing_files_are_named(folders, tmp_path, model, file, message):
    for folder in folders[:2]:
        shutil.copytree(folder, tmp_path / folder.name)
    (tmp_path / model / file).unlink()
    with pytest.raises(InputError, match=message):
        GroundedSam.from_folders(tmp_path / "dino", tmp_path / "sam")


@pytest.mark.door
def test_folders_in_the_wrong_order_and_no_folder_are_errors(folders, tmp_path):
    dino, sam, *_ = folders
    with pytest.raises(InputError, match="lacks tokenizer.json|model_type 'sam'"):
        load_segmenter(f"{sam},{dino}")
    with pytest.raises(InputError, match="nowhere: no such folder"):
        load_segmenter(f"{tmp_path / 'nowhere'},{sam}")


@pytest.mark.door
def test_damaged_weights_are_one_line(folders, tmp_path):
    shutil.copytree(folders[1], tmp_path / "sam")
    (tmp_path / "sam" / "model.safetensors").write_bytes(b"damaged")
    with pytest.raises(InputError, match="sam: cannot be read"):
        GroundedSam.from_folders(folders[0], tmp_path / "sam")


@pytest.mark.parametrize("change", [{"box_threshold": 1.5}, {"text_threshold": -0.1}])
def test_thresholds_are_probabilities(folders, change):
    with pytest.raises(ValueError, match=r"expected a number in \[0, 1\]"):
        GroundedSam.from_folders(*folders[:2], **change)


@pytest.fixture(scope="module")
def clip():
    return ClipSegmenter.bundled()


def test_the_bundled_segmenter_cuts_a_held_out_snowman_out(clip):
    """Oracle: the ray-cast world's own pixels. The report has the overlap with many worlds, also the bad ones."""
    split = PAIR_SPLITS["edit-test"]
    world, look = edit_world(22, split), edit_looks(22, split)[0][0]
    made, hits = pictures(world, [look], 128, view=0)
    exact = hits.valid & (shown_things(hits.object_id, world) == THING)
    image = made[0].astype(np.float32) / 255
    mask = clip.segment(image, "snowman")
    assert mask.shape == exact.shape and mask.dtype == np.bool_
    assert (mask & exact).sum() / (mask | exact).sum() > 0.9
    large = cv2.resize(image, (512, 512), interpolation=cv2.INTER_NEAREST)
    assert clip.segment(large, "snowman").shape == (512, 512)


@pytest.mark.door
@pytest.mark.filterwarnings("ignore:'(roof|cap)' is hardly recognised")
def test_the_bundled_segmenter_cuts_parts_of_held_out_things_out(clip):
    """Oracle: the pixels that rays hit. A third of the parts may be missed, as the report has it."""
    overlaps = []
    for kind, part in (("house", "roof"), ("mushroom", "cap")):
        for images, exact in unseen_worlds.part_of(kind, part):
            for image in images:
                try:
                    mask = clip.segment(image, part)
                except NoDetectionError:
                    mask = np.zeros_like(exact)
                overlaps.append((mask & exact).sum() / (mask | exact).sum())
    assert np.mean(overlaps) > 0.5


class Halves:
    """Says that a ball is in the left half; keeps the sizes of the pictures that it is shown."""

    def __init__(self, likely=0.9):
        self.sizes, self.likely = [], likely

    def shown(self, image, texts):
        assert texts == ["a photo of ball"]
        self.sizes.append(image.shape[:2])
        height, width = (max(1, side // 8) for side in image.shape[:2])
        probability = np.full((height, width, 1), 0.1)
        probability[:, : width // 2] = self.likely
        return probability


def test_a_segmenter_follows_the_probabilities_of_its_encoder():
    """Oracle: two halves of one colour each, of which an encoder that is made by hand says which it is."""
    image = np.full((96, 128, 3), 0.2)
    image[:, 64:] = 0.8
    segmenter = ClipSegmenter(Halves())
    relevance = segmenter.relevance(image, "ball")
    assert relevance.shape == (96, 128)
    assert relevance[:, :48] == pytest.approx(0.9) and relevance[:, 80:] == pytest.approx(0.1)
    assert (segmenter.segment(image, "ball") == (image[..., 0] < 0.5)).all()
    with pytest.raises(NoDetectionError):
        dataclasses.replace(segmenter, detection=0.95).segment(image, "ball")
    assert {(128, 171), (192, 256), (256, 341)} <= set(segmenter.encoder.sizes)


def test_words_that_are_hardly_recognised_are_warned_of():
    """Oracle: an encoder that is made by hand; other tests fail if likely words were warned of."""
    image = np.full((96, 128, 3), 0.2)
    image[:, 64:] = 0.8
    with pytest.warns(InputWarning, match=r"'ball' is hardly recognised: 50% likely .*--at X,Y"):
        mask = ClipSegmenter(Halves(0.5)).segment(image, "ball")
    assert (mask == (image[..., 0] < 0.5)).all()


def test_a_long_picture_is_rated_at_a_bounded_size():
    image = np.full((48, 2400, 3), 0.2)
    image[:, 1200:] = 0.8
    segmenter = ClipSegmenter(Halves())
    mask = segmenter.segment(image, "ball")
    assert {max(size) for size in segmenter.encoder.sizes} == {1024}
    expected = image[..., 0] < 0.5
    assert (mask & expected).sum() / (mask | expected).sum() > 0.99


@pytest.mark.door
def test_nothing_in_an_empty_picture_is_an_error(clip):
    with pytest.raises(NoDetectionError, match="no 'dinosaur' was detected"):
        clip.segment(np.full((40, 50, 3), 0.5), "dinosaur")


@pytest.mark.door
@pytest.mark.parametrize("words", ["", " ", "..."])
def test_words_without_letters_are_refused(clip, words):
    with pytest.raises(InputError, match="words: got"):
        clip.segment(IMAGE, words)


@pytest.mark.door
@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((4, 5)), r"got shape \(4, 5\), expected \(H, W, 3\)"),
        (PIXELS, "got uint8"),
        (2 * np.ones((4, 5, 3)), r"expected \[0, 1\]"),
    ],
)
def test_other_pictures_are_refused(clip, image, message):
    with pytest.raises(ValueError, match=message):
        clip.segment(image, "bear")


def two_squares():
    """A red square of 20 px and a blue one on grey, 60 x 80 px, with a little grain."""
    picture = np.full((60, 80, 3), 0.4, np.float32)
    picture[10:30, 10:30] = (0.8, 0.1, 0.1)
    picture[30:50, 50:70] = (0.1, 0.2, 0.8)
    grain = np.random.default_rng(0).normal(0, 0.02, picture.shape)
    return np.clip(picture + grain, 0, 1).astype(np.float32)


@pytest.mark.parametrize(
    "marks",
    [{"box": (46, 26, 74, 54)}, {"at": (60, 40)}],
    ids=["a box around it", "a click on it"],
)
def test_what_a_person_marks_is_cut_out_alone(marks):
    expected = np.zeros((60, 80), dtype=bool)
    expected[30:50, 50:70] = True
    assert np.array_equal(cut_out(two_squares(), **marks), expected)


@pytest.mark.parametrize(
    "marks, message",
    [
        ({"at": (90, 4)}, "--at: got 90,4, expected px inside the picture of 80 x 60"),
        ({"box": (1, 2, 99, 40)}, "--box: got 1,2,99,40, expected px inside"),
        ({"box": (30, 9, 10, 40)}, "--box: got 30,9,10,40, expected X0,Y0,X1,Y1 with X0 < X1"),
        ({}, "expected either a box or a point"),
        ({"at": (3, 4), "box": (1, 2, 9, 9)}, "expected either a box or a point"),
    ],
)
def test_marks_that_say_nothing_are_refused(marks, message):
    with pytest.raises(InputError, match=re.escape(message)):
        cut_out(two_squares(), **marks)


@pytest.mark.parametrize(
    ("shape", "marks"),
    [
        ((900, 1200), {"box": (600, 400, 603, 403)}),  # less than a pixel of what is cut
        pytest.param((2, 2), {"box": (0, 0, 2, 2)}, marks=pytest.mark.door),
        pytest.param((2, 2), {"at": (1, 1)}, marks=pytest.mark.door),
        pytest.param((1, 1), {"at": (1, 1)}, marks=pytest.mark.door),
    ],
)
def test_a_mark_of_too_few_pixels_is_one_line_of_its_own(shape, marks):
    with pytest.raises(InputError, match="nothing stands out there by its colours; try"):
        cut_out(np.full((*shape, 3), 0.4, np.float32), **marks)


def test_a_box_around_the_whole_picture_still_cuts():
    mask = cut_out(two_squares(), box=(0, 0, 80, 60))
    assert mask.shape == (60, 80)
