"""Shares on the page `which-metric`, recomputed from the raw results of the frozen audit."""

import json
import lzma
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[4]
RIGHT = ("right", "right_other")
NEAR = [0, 1, 2, 3]
"""Views of 2, 10, 30 and 60 degrees."""

SAID = [
    ("colour the edit adds", "consistency.edit_delta_e", -1, {"answer=1": 100, "slid=4": 95, "blur=2": 75}),
    ("perceptual distance", "consistency.perceptual", -1, {"answer=1": 100, "blur=2": 100, "slid=4": 96, "doubled=1": 65}),
    ("colour, rendered", "consistency.rendered_delta_e", -1, {"answer=1": 100, "slid=4": 94, "blur=2": 74}),
    ("flow warp error", "consistency.flow_delta_e.dis", -1, {"answer=1": 94, "slid=4": 74, "blur=2": 64}),
    ("features", "consistency.features.rendered", -1, {"answer=1": 96, "slid=4": 52}),
    ("CLIP between", "embedding.clip_image", 1, {"answer=1": 90, "slid=4": 60, "noise=0.03": 65}),
    ("TSED", "consistency.tsed_2px", 1, {"answer=1": 55}),
]  # fmt: skip


@pytest.fixture(scope="module")
def records():
    raw = lzma.decompress((ROOT / "reports/audit/frozen-0.jsonl.xz").read_bytes()).decode()
    lines = [json.loads(line) for line in raw.splitlines()]
    return [one["record"] for one in lines if one.get("cell", {}).get("probe") == "audit"]


def share(records, key, sign, flaw):
    """Percent of flawed pairs that rank below the mean of the right ones of their scene and yaw."""
    won = []
    for record in records:
        for place in NEAR:
            values = record["views"][place]["metrics"]
            flawed, *right = (values.get(f"{key}.{name}") for name in (flaw, *RIGHT))
            right = [value for value in right if value is not None]
            if flawed is not None and right:
                difference = sign * (np.mean(right) - flawed)
                won.append((difference > 0) + 0.5 * (difference == 0))
    return 100 * np.mean(won)


@pytest.mark.parametrize(("title", "key", "sign", "shares"), SAID)
def test_the_page_has_the_shares_of_the_raw_results(records, title, key, sign, shares):
    page = (ROOT / "docs/measuring/which-metric.md").read_text().splitlines()
    (line,) = (line for line in page if line.startswith(f"| {title}"))
    for flaw, percent in shares.items():
        assert share(records, key, sign, flaw) == pytest.approx(percent, abs=1), flaw
        assert f"{percent} %" in line


def test_blur_games_edit_psnr_and_another_answer_a_similarity_to_words(records):
    page = (ROOT / "docs/measuring/which-metric.md").read_text()
    blurred = share(records, "consistency.edit_psnr", 1, "blur=2")
    other = share(records, "embedding.clip_directional", 1, "answer=1")
    assert f"{100 - blurred:.0f} % of blurred pairs score better" in page
    assert f"another answer: {100 - other:.0f} % score better" in page
