"""Shares on the page `which-metric`, recomputed from the raw results of the audit."""

import json
import lzma
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[4]
RIGHT = ("right", "right_other")

SAID = [
    ("colour the edit adds", "consistency.edit_delta_e.fitted", -1, {"answer=1": 100, "slid=4": 100, "blur=2": 98, "blur=1": 70, "doubled=1": 56, "flat_all=1": 7, "blur_all=2": 31, "weak_all=0.5": 26}),
    ("perceptual distance", "consistency.perceptual.fitted", -1, {"answer=1": 100, "blur=2": 100, "blur=1": 98, "slid=4": 98, "doubled=1": 36}),
    ("colour |", "consistency.rendered_delta_e.fitted", -1, {"answer=1": 100, "doubled=1": 57, "flat_all=1": 6, "blur_all=2": 30, "weak_all=0.5": 8}),
    ("reprojection loss", "consistency.rendered_mae_srgb.fitted", -1, {"answer=1": 100, "doubled=1": 47, "flat_all=1": 8, "blur_all=2": 24}),
    ("features", "consistency.features.fitted", -1, {"answer=1": 98, "blur=2": 99, "slid=4": 60, "doubled=1": 28}),
    ("flow warp error", "consistency.flow_delta_e", -1, {"answer=1": 93, "doubled=1": 90, "slid=4": 66, "blur=2": 64, "blur_all=2": 1}),
    ("held-out PSNR", "consistency.held_psnr.fitted", 1, {"answer=1": 100, "blur=2": 38, "blur_all=2": 8, "weak_all=0.5": 4}),
    ("Edit PSNR", "consistency.fitted_psnr.fitted", 1, {"answer=1": 100, "blur=2": 33, "blur=1": 4, "blur_all=2": 0, "flat_all=1": 4}),
    ("CLIP between", "embedding.clip_neighbours", 1, {"blur=2": 98, "slid=4": 65, "answer=1": 75}),
    ("TSED", "consistency.tsed_2px", 1, {"answer=1": 58}),
    ("CLIP directional", "embedding.clip_directional", 1, {"answer=1": 48, "slid=4": 58}),
]  # fmt: skip


@pytest.fixture(scope="module")
def records():
    raw = lzma.decompress((ROOT / "reports/audit/results.jsonl.xz").read_bytes()).decode()
    lines = [json.loads(line) for line in raw.splitlines()]
    return [one["record"] for one in lines if one.get("cell", {}).get("probe") == "audit"]


def share(records, key, sign, flaw):
    """Percent of flawed pairs that rank below the mean of the right ones of their scene and yaw."""
    won = []
    for record in records:
        for view in record["views"]:
            values = view["metrics"]
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
