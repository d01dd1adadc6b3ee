"""Text of a card besides its figures."""

import hashlib

from training.encoders.__main__ import _facts
from training.encoders.cards import card


def encoder():
    from attnwarp.encoders.base import EncoderInfo
    from attnwarp.encoders.nets import PerceptualSmall

    about = EncoderInfo("perceptual-small", "perceptual", "bundled", "", "")
    return type("Stub", (), {"net": PerceptualSmall(), "about": about})()


def made(facts, files=()):
    figure = {
        "what": "order",
        "value": 0.9,
        "low": 0.8,
        "high": 0.95,
        "count": 10,
        "chance": 0.5,
        "asked": 0.95,
    }
    return card(
        "perceptual-small",
        [figure],
        [figure | {"value": 0.4}],
        facts | {"seconds": 0.5, "threads": 1},
        files,
    )


def test_a_card_says_how_long_training_took_where_the_checkpoint_is_at_hand(tmp_path):
    import torch

    without = _facts("perceptual-small", encoder(), tmp_path)
    assert without["minutes"] is None and "trained in" not in made(without)
    torch.save({"model": {}, "seconds": 42 * 60.0 + 10}, tmp_path / "perceptual-small.pt")
    text = made(_facts("perceptual-small", encoder(), tmp_path))
    assert ", trained in 42 minutes." in text
    assert "| order | **90.0 %** (80.0 to 95.0) | 40.0 % | 50.0 % | 95 % | 10 |" in text
    assert "Short of what was asked for: order." in text


def test_a_card_has_the_hash_of_each_file_and_the_one_that_results_name(tmp_path):
    from attnwarp.encoders import load_encoder
    from attnwarp.encoders.bundled import WEIGHTS

    facts = _facts("perceptual-small", encoder(), tmp_path)
    weights, words = WEIGHTS / "clip-small.safetensors", WEIGHTS / "clip-small.tokenizer.json"
    text = made(facts, [weights, words])
    for path in (weights, words):
        assert (
            f"| `{path.name}` | {path.stat().st_size} | `{hashlib.sha256(path.read_bytes()).hexdigest()}` |"
            in text
        )
    together = hashlib.sha256(weights.read_bytes() + words.read_bytes()).hexdigest()
    assert f"by which results name the encoder: `{together}`." in text
    assert load_encoder("clip-small", "clip").about.weights_sha256 == together
    assert "results name" not in made(facts, [weights])  # one file's hash is that already
