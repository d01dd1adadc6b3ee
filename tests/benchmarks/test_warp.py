"""Measurements of the warp's benchmark, whose contestants compute the same."""

from __future__ import annotations

import pytest
import torch

from benchmarks import warp


def test_a_small_run_ends_in_a_table() -> None:
    cases = [
        warp.pair_case(64),
        warp.tokens_case(8, 16, torch.float32, others=True),
        warp.tokens_case(8, 16, torch.bfloat16, others=False),
    ]
    result = warp.run(cases, rounds=6)
    copies = [row for row in result["rows"] if row["contestant"] == "copy"]
    assert [row["bytes"] for row in copies] == [2 * 2 * 64 * 16 * size for size in (4, 2)]
    assert all(row["bandwidth_share"] == pytest.approx(1) for row in copies)
    assert all(row["interval"] == pytest.approx([1, 1]) for row in copies)
    again = [row for row in result["rows"] if row["contestant"].endswith(", again")]
    assert [row["contestant"] for row in again] == ["render, again", "copy, again", "copy, again"]
    for row in again:  # the same work a second time: its ratio is noise, and is not 1 by definition
        assert 0 < row["interval"][0] <= row["interval"][1] and row["interval"] != [1, 1]
    assert all(0 < row["taps"] <= 4 * 2 * 64 * 16 for row in copies)
    assert all(0 < row["wall_best_ms"] <= row["wall_ms"] for row in result["rows"])
    text = warp.table(result)
    assert "grid_sample" in text and "kornia" in text and "bfloat16" in text
    assert len(text.splitlines()) == 4 + len(result["rows"])


def test_the_contestants_warp_alike() -> None:
    work = warp.tokens_case(16, 4, torch.float32, others=True).contestants
    tokens, maps, definition, sampled, kornia = (
        work[name]() for name in ("tokens", "maps", "definition", "grid_sample", "kornia")
    )
    assert isinstance(tokens, torch.Tensor) and isinstance(maps, torch.Tensor)
    assert torch.equal(tokens, definition)
    as_tokens = lambda t: t.flatten(2).transpose(1, 2)  # noqa: E731
    assert torch.equal(as_tokens(maps), tokens)
    defined = (tokens != 0).any(dim=(0, 2))
    assert defined.float().mean() > 0.5
    # grid_sample takes positions in float32.
    assert ((as_tokens(sampled) - tokens)[:, defined]).abs().max() < 1e-4
    assert kornia.shape == maps.shape
