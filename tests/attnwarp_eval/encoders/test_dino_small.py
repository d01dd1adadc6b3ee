"""dino-small. Oracle: worlds whose contents are known, rendered anew here."""

import numpy as np
import pytest

from attnwarp_eval.encoders import TokenEncoder, load_encoder
from training.worlds.data import Pictures, Split, looks_of, render_world


@pytest.fixture(scope="module")
def dino():
    return load_encoder("dino-small", "dino")


def test_it_is_what_the_door_promises(dino):
    assert isinstance(dino, TokenEncoder)
    assert (dino.about.name, dino.about.source) == ("dino-small", "bundled")
    assert dino.images([]).shape == (0, dino.about.dim)
    assert dino.tokens([]).shape == (0, 8, 8, dino.about.dim)


def test_an_embedding_does_not_depend_on_what_else_is_in_the_list(dino):
    rng = np.random.default_rng(0)
    pictures = [rng.uniform(size=(*size, 3)) for size in ((128, 128), (90, 200), (300, 170))]
    for encode in (dino.images, dino.tokens):
        together = encode(pictures)
        for k, picture in enumerate(pictures):
            assert np.allclose(
                encode([picture])[0], together[k], atol=1e-4 * np.abs(together).max()
            )


@pytest.mark.slow
def test_a_thing_is_found_from_another_side_more_often_than_by_its_pixels(dino):
    split = Split(91_000_000, 64, pairs="any", new_shapes=True, bare=True)
    assert looks_of(91_000_000, 0, split)[0].ground == looks_of(91_000_001, 1, split)[0].ground
    seeds = range(split.first, split.first + split.worlds)
    rows = [
        (image, shown, seed, view, look)
        for seed in seeds
        for image, shown, view, look in render_world(seed, split)
    ]
    pictures = Pictures(*(np.array(column) for column in zip(*rows, strict=True)))
    images = pictures.images.astype(np.float32) / 255
    small = images.reshape(len(images), 32, 5, 32, 5, 3).mean(axis=(2, 4)).reshape(len(images), -1)

    def found(features):
        """Share of things whose nearest first view is their own, by the cosine."""
        rows = features / np.linalg.norm(features, axis=1, keepdims=True)
        first, second = (rows[pictures.view == view] for view in (0, 1))
        return ((second @ first.T).argmax(axis=1) == np.arange(len(first))).mean()

    ours = found(dino.images(list(images)))
    assert ours > 0.85
    assert ours > found(small - small.mean(axis=1, keepdims=True)) + 0.5
