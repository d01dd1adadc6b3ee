"""Figures in the bullets of README.md, recomputed from the raw results that lie beside their reports."""

import json
import lzma
from collections import defaultdict
from functools import cache
from pathlib import Path
from statistics import median

import numpy as np
import pytest

ROOT = Path(__file__).parents[3]
README = " ".join((ROOT / "README.md").read_text().split())
SEEN, KEPT = ("ideal", "parts.seen.edit"), ("warp", "occlusion.recall")
ANSWER = ("editing", "multiview.same_answer.edit")
APART = ("editing", "multiview.delta_e_above.edit_inside")

SENTENCES = [
    ("fitted/undensified", SEEN, ["2DGS fit, extended"], "`extended` brings [{:.0%}]"),
    ("fitted/undensified", SEEN, ["2DGS fit", "3DGS fit, extended", "3DGS fit"], "`corrected` {:.0%} (3DGS: {:.0%} and {:.0%})"),
    ("fitted/undensified", SEEN, ["2DGS fit, each view alone"], "each view alone {:.0%}, `extended` with exact"),
    ("fitted/undensified", SEEN, ["exact depth and mask"], "exact depth and mask {:.0%} (24 scenes"),
    ("fitted/undensified", KEPT, ["2DGS fit, tolerant", "2DGS fit"], "mask keeps {:.0%} of what is visible there, that of `corrected` {:.0%}"),
    ("ablation", ANSWER, ["shared: corrected"], "[{:.0%}](reports/ablation/report.md) with carried features and without"),
    ("ablation", ANSWER, ["shared: each view alone"], "[{:.0%}](reports/ablation/report.md) with carried features and without"),
    ("ablation", APART, ["shared: each view alone", "shared: corrected"], "differ more alone, by {:.1f} for {:.1f} dE00"),
]  # fmt: skip


@cache
def cells(study):
    (path,) = (ROOT / "reports" / study).glob("*.jsonl.xz")
    raw = lzma.decompress(path.read_bytes()).decode()
    return [one for one in map(json.loads, raw.splitlines()) if "cell" in one]


def by_scene(study, probe, metric, variant):
    """Means over views, of the edit that has several right answers if edits differ."""
    scenes = defaultdict(list)
    for one in cells(study):
        cell, record = one["cell"], one["record"]
        own = record.get("edit", {}).get("name") in (None, "some_colour")
        if own and cell["probe"] == probe and variant in cell["variants"]:
            values = [view["metrics"].get(metric) for view in record["views"]]
            scenes[cell["scene"]] += [value for value in values if value is not None]
    return {scene: np.mean(values) for scene, values in scenes.items() if values}


@pytest.mark.parametrize(("study", "figure", "variants", "sentence"), SENTENCES)
def test_a_bullet_has_the_means_of_the_raw_results(study, figure, variants, sentence):
    means = [np.mean([*by_scene(study, *figure, each).values()]) for each in variants]
    assert sentence.format(*means).replace("%", " %") in README


def test_the_bullet_on_editors_that_move_the_picture_has_what_is_lost_of_the_gain():
    def lost(figure, editor, shift):
        both = "attention warping", "each view alone"
        sides = [
            by_scene("drift-study", *figure, f"{method}{editor}, {px} px")
            for px in (0, shift)
            for method in both
        ]
        before, alone, after, alone_after = (
            np.mean([side[scene] for scene in set.intersection(*map(set, sides))]) for side in sides
        )
        return 100 * (1 - (after - alone_after) / (before - alone))

    small, large = ([lost(SEEN, ", ideal", shift), lost(APART, "", shift)] for shift in (2, 8))
    told = (
        "costs attention warping [{:.0f} %](reports/drift-study/report.md) of its gain over views"
    )
    assert told.format(small[0]) in README
    assert f"ideal editor, {small[1]:.0f} % with a bundled one" in README
    assert "8 px cost {:.0f} % and {:.0f} %".format(*large) in README


def test_the_bullet_on_metrics_counts_the_scenes_in_which_a_blurred_set_scores_higher():
    def higher(flaw):
        scenes = defaultdict(list)
        for one in cells("audit"):
            if one["cell"]["probe"] == "audit":
                values = one["record"]["views"][0]["metrics"]
                right, blurred = (
                    values[f"consistency.fitted_psnr.fitted.{name}"] for name in ("right", flaw)
                )
                scenes[one["cell"]["scene"]].append(blurred > right)
        return sum(map(all, scenes.values())), len(scenes)

    told = "Edit PSNR scores higher than the right edit in {} of {} scenes if one view"
    assert told.format(*higher("blur=1")) in README
    all_blurred, scenes = higher("blur_all=2")
    assert all_blurred == scenes and "and in all if every view is blurred by 2 px" in README


def test_the_bullet_on_photographs_has_the_medians_of_the_tracks():
    files = [
        json.loads((ROOT / f"reports/tracks/bear-{kind}dgs.json").read_text()) for kind in "23"
    ]
    medians = {
        preset: [
            row["figures"]["median"]["value"]
            for file in files
            for row in file["rows"]
            if (row["preset"], row["apart"], row["views"]) == (preset, 1, "all")
        ]
        for preset in ("paper", "corrected")
    }
    assert "{:.2f} against {:.2f} px between neighbouring".format(*medians["paper"]) in README
    assert "both are at {:.2f} to {:.2f} px".format(*medians["corrected"]) in README


def test_the_bullet_on_light_has_the_median_prices_of_the_scenes_within_their_bounces():
    scenes = json.loads((ROOT / "reports/effects/effects.json").read_text())["scenes"]
    caps = [scene["cost"].get("cap") or scene["cost"] for scene in scenes]
    same_error = median(cap.get("at_equal_error", cap.get("at_equal_noise")) for cap in caps)
    same_samples = median(cap["faster"] for cap in caps)
    assert f"takes [{same_error:.1f} times as long](reports/effects/effects.md) to the" in README
    told = "same error, and {:.1f} times with the same samples, in the median of {} hand-made"
    assert told.format(same_samples, len(scenes)) in README
    page = (ROOT / "reports/effects/effects.md").read_text()
    for again in json.loads((ROOT / "reports/effects/coplanar.json").read_text()):
        assert "{:+.1%} [{:+.1%}, {:+.1%}]".format(again["bias"], *again["bias_interval"]) in page
