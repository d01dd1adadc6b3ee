"""dino-small. Oracle: worlds whose contents are known, rendered anew here."""

import numpy as np
import pytest
import unseen_worlds

from attnwarp_eval.encoders import TokenEncoder, load_encoder


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
    images = unseen_worlds.things(91_000_000, 64, looks=1, bare=True)[0][:, :, 0]
    small = images.reshape(64, 2, 32, 5, 32, 5, 3).mean(axis=(3, 5)).reshape(128, -1)

    def found(features):
        """Share of things whose nearest first view is their own, by the cosine."""
        rows = features / np.linalg.norm(features, axis=1, keepdims=True)
        first, second = rows[::2], rows[1::2]
        return ((second @ first.T).argmax(axis=1) == np.arange(len(first))).mean()

    ours = found(dino.images(list(images.reshape(128, 160, 160, 3))))
    assert ours > 0.85
    assert ours > found(small - small.mean(axis=1, keepdims=True)) + 0.5
