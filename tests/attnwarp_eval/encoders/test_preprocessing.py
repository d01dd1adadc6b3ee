"""The steps that a folder's file names are those of transformers."""

import json

import numpy as np
import pytest

from attnwarp.encoders.preprocess import Preprocessing
from attnwarp.errors import InputError
from attnwarp_eval.encoders.preprocessing import read_preprocessing


@pytest.fixture
def random():
    return np.random.default_rng(0)


@pytest.mark.parametrize(
    "said",
    [
        {"size": {"shortest_edge": 24}, "crop_size": {"height": 20, "width": 20}},
        {"size": {"height": 20, "width": 26}, "do_center_crop": False},
        {"size": {"shortest_edge": 24}, "crop_size": {"height": 30, "width": 20}, "resample": 2},
        {
            "size": {"shortest_edge": 24},
            "crop_size": {"height": 20, "width": 20},
            "rescale_factor": 1 / 127.5,
        },
        {
            "size": {"shortest_edge": 24},
            "crop_size": {"height": 20, "width": 20},
            "do_normalize": False,
        },
        {"do_resize": False, "crop_size": {"height": 33, "width": 20}},
    ],
)
@pytest.mark.parametrize("shape", [(40, 50), (51, 33), (24, 24)])
def test_a_whole_pipeline_is_that_of_transformers(tmp_path, random, said, shape):
    from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil

    processor = CLIPImageProcessorPil(**said)
    processor.save_pretrained(tmp_path)
    # Squeezed to another shape Pillow takes the axes in another order, which shows in what
    # overshoots: so nothing does.
    low, high = (64, 192) if "height" in said.get("size", {}) else (0, 256)
    picture = random.integers(low, high, (*shape, 3), dtype=np.uint8)
    expected = processor([picture], return_tensors="np")["pixel_values"][0]
    ours = read_preprocessing(tmp_path)
    got = ours((picture / 255).astype(np.float32))
    assert got.shape == expected.shape and got.dtype == np.float32
    step = ours.scale / 255 / min(ours.std)  # of one step of 8 bits, behind the normalisation
    assert np.abs(got - expected).max() < 1.25 * step


def test_sizes_of_old_files_are_single_numbers(tmp_path):
    # As published with openai/clip-vit-large-patch14-336.
    old = {
        "crop_size": 336,
        "do_center_crop": True,
        "do_normalize": True,
        "do_resize": True,
        "resample": 3,
        "size": 336,
        "feature_extractor_type": "CLIPFeatureExtractor",
        "image_mean": [0.48145466, 0.4578275, 0.40821073],
        "image_std": [0.26862954, 0.26130258, 0.27577711],
    }
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(old))
    ours = read_preprocessing(tmp_path)
    assert (ours.resize, ours.crop, ours.scale) == (336, (336, 336), 1.0)
    assert (
        str(ours)
        == "resized the shorter edge to 336 px (bicubic, antialiased, floating); the central 336 x"
        " 336 px cut out; minus (0.4815, 0.4578, 0.4082), over (0.2686, 0.2613, 0.2758)"
    )


def test_the_part_of_a_newer_file_is_found(tmp_path):
    part = {
        "image_processor_type": "CLIPImageProcessorFast",
        "size": {"shortest_edge": 30},
        "crop_size": 28,
    }
    (tmp_path / "processor_config.json").write_text(json.dumps({"image_processor": part}))
    ours = read_preprocessing(tmp_path)
    assert isinstance(ours, Preprocessing) and ours.resize == 30 and ours.shape == (28, 28)


@pytest.mark.parametrize(
    "said, complaint",
    [
        (None, "no preprocessor_config.json or processor_config.json; place"),
        ("{", "not JSON"),
        ("[1]", "holds a list, expected an object"),
        (
            '{"image_processor_type": "SamImageProcessor"}',
            "is 'SamImageProcessor', expected one of CLIPImageProcessor",
        ),
        ('{"size": {"longest_edge": 300}}', "is not known here, expected shortest_edge"),
        ('{"size": 0}', "size 0 is not a number of px"),
        ('{"resample": 9}', "resample 9 is not known"),
        ('{"image_mean": [0.5]}', r"image_mean is \[0.5\], expected three numbers"),
        ('{"do_pad": true}', "do_pad is set, which is not supported"),
        (
            '{"rescale_factor": "1/255"}',
            "could not convert string to float: '1/255'; place the file",
        ),
        ('{"image_std": ["0.5", 0.5, 0.5]}', "image_std is .*, expected three numbers"),
    ],
)
def test_a_file_that_is_not_understood_is_refused_by_name(tmp_path, said, complaint):
    if said is not None:
        (tmp_path / "preprocessor_config.json").write_text(said)
    with pytest.raises(InputError, match=complaint) as caught:
        read_preprocessing(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_a_factor_that_is_not_used_is_not_looked_at(tmp_path):
    said = {"do_rescale": False, "rescale_factor": None}
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(said))
    assert read_preprocessing(tmp_path).scale == 255  # of bytes, as they are


@pytest.mark.door
def test_a_part_of_a_newer_file_that_is_no_object_is_refused_by_name(tmp_path):
    (tmp_path / "processor_config.json").write_text('{"image_processor": "CLIPImageProcessor"}')
    with pytest.raises(
        InputError, match="image_processor is 'CLIPImageProcessor', expected an obj"
    ):
        read_preprocessing(tmp_path)
