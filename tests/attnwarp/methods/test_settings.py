"""Oracle: the table "where paper and released code differ" of the method, written out."""

from dataclasses import fields, replace

import pytest
import torch

import attnwarp.warp
from attnwarp.methods import PRESETS as ALL_PRESETS
from attnwarp.methods import AttentionWarpingSettings
from attnwarp.methods import preset as any_preset
from attnwarp.methods.stages import draw_stages

PRESETS = ALL_PRESETS["attention_warping"]


def preset(name, **changes):
    return any_preset("attention_warping", name, **changes)


TABLE = {
    # field: (paper, released, corrected)
    "views_per_stage": (40, 40, None),
    "fill_last_stage": (False, True, False),
    "iterations": (300, 960, 300),
    "grid": ("even", "scheduler", "even"),
    "start_picture": ("original", "by_stage", "original"),
    "warp": tuple(attnwarp.warp.PRESETS[name] for name in ("paper", "released", "corrected")),
    "noise": ("shared", "shared", "shared"),
    "start": (None, (700, 980), None),
    "depth_from": ("current", "current", "frozen"),
    "training": ("stage", "modulo", "all"),
    "text_guidance": (None, 12.5, None),
    "guidance_drop": (0.0, 1.5, 0.0),
    "composite": ("black", "original", "original"),
    "composite_blur": (0.0, 1.5, 0.0),
    "psnr_views": ("all", "before_last_stage", "all"),
    "color_rate": (1.0, 1.0, 4.0),
    "background": ("black", "random", "black"),
}


@pytest.mark.parametrize(("name", "column"), [("paper", 0), ("released", 1), ("corrected", 2)])
def test_presets_are_the_columns_of_the_table_and_agree_in_all_else(name, column):
    changed = {field: values[column] for field, values in TABLE.items()}
    assert PRESETS[name] == replace(AttentionWarpingSettings(), **changed)


def test_a_controlnet_of_the_released_code_draws_fresh_noise_and_has_other_guidance():
    one, other = PRESETS["released"], PRESETS["released-controlnet"]
    differing = {f.name for f in fields(one) if getattr(one, f.name) != getattr(other, f.name)}
    assert differing == {
        "noise", "start", "grid", "latents", "guidance_drop", "source_text_guidance", "suffix", "negative_prompt",
    }  # fmt: skip
    assert [other.inverts(stage) for stage in range(3)] == [False, True, True]
    assert (
        other.suffix == ", best quality, extremely detailed"
        and other.negative_prompt.startswith("longbody, lowres")
    )
    assert other.noise == "fresh"
    assert other.source_text_guidance == 7.5
    assert [other.guidance(stage) for stage in range(3)] == [12.5, 12.5, 12.5]
    assert [one.guidance(stage) for stage in range(3)] == [12.5, 11.0, 9.5]


def test_a_short_last_stage_is_filled_with_views_edited_before():
    settings = AttentionWarpingSettings(stages=3, views_per_stage=4, fill_last_stage=True, seed=3)
    plain = draw_stages(range(1, 11), replace(settings, fill_last_stage=False))
    stages = draw_stages(range(1, 11), settings)
    assert [len(stage) for stage in plain] == [4, 4, 2] and stages[:2] == plain[:2]
    assert stages[2][:2] == plain[2] and len(stages[2]) == 4
    assert set(stages[2][2:]) <= {*stages[0], *stages[1]} and len({*stages[2]}) == 4
    # With nothing edited before there is nothing to fill it with.
    assert [len(s) for s in draw_stages(range(1, 4), settings)] == [3]


def test_extended_is_corrected_with_ideas_beyond_the_paper():
    ideas = {
        "noise": "surface", "warp": attnwarp.warp.preset("tolerant"), "unseen": "attend",
        "a0": 1.0, "decay": "by_kind", "training": "lifted", "iterations": 50, "color_rate": 1.0,
    }  # fmt: skip
    assert PRESETS["extended"] == replace(PRESETS["corrected"], **ideas)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ([("warp", {"opaque": 0.9})], {"opaque": 0.9}),
        ([("warp.opaque", 0.9)], {"opaque": 0.9}),
        ([("warp", {"opaque": 0.9}), ("warp.normal_angle", 30)], {"opaque": 0.9, "normal_angle": 30}),
        ([("warp.normal_angle", 30), ("warp", {"opaque": 0.9})], {"opaque": 0.9, "normal_angle": 30}),
        ([("warp", {})], {}),
    ],
    ids=["dict", "dotted", "dict then dotted", "dotted then dict", "empty"],
)  # fmt: skip
def test_a_dictionary_changes_the_fields_that_it_names(changes, expected):
    released = PRESETS["released"]
    for changed in (preset("released", **dict(changes)), released.changed(**dict(changes))):
        assert changed == replace(released, warp=replace(released.warp, **expected))


@pytest.mark.parametrize(
    ("steps", "shares", "numbers"),
    [
        (20, (0.0, 1.0), range(20)),
        (20, (0.0, 0.5), range(10)),
        (20, (0.5, 1.0), range(10, 20)),
        (30, (0.1, 0.7), range(3, 21)),  # both products are off by a rounding in floats
        (3, (0.0, 0.5), range(2)),  # steps 0 and 1 begin before half of the way
        (1, (0.0, 0.2), range(1)),
    ],
)
def test_shares_of_the_steps_are_those_that_begin_within(steps, shares, numbers):
    assert preset("corrected", steps=steps, feature_steps=shares).feature_range() == numbers


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"a0": 1.5}, "a0: got 1.5, expected a number in"),
        ({"steps": 0}, "steps: got 0"),
        ({"steps": 2.5}, "steps: got 2.5, expected a whole number"),
        ({"noise": "frsh"}, "did you mean 'fresh'"),
        ({"start": (5, 3)}, "start: got \\[5, 3\\]"),
        ({"start": (700, 1000)}, "start: got \\[700, 1000\\], .* in \\[0, 999\\]"),
        ({"stagse": 1}, "did you mean 'stages'"),
        ({"a_0": 1}, r"setting: got 'a_0'; did you mean 'a0'\?.{,40}$"),
        ({"warp.opaqe": 1}, "did you mean 'opaque'"),
        ({"warp": {"opaqe": 1}}, "did you mean 'opaque'"),
        ({"a0.opaque": 1}, "a0: got 0.9, expected its fields by name"),
        ({"mask": 1}, "mask: got 1, expected true or false"),
        ({"stages": 0}, "stages: got 0, expected a whole number >= 1"),
        (
            {"text_guidance": 1.5, "guidance_drop": 1.0, "stages": 3},
            "text_guidance, guidance_drop: got 1.5 and 1, so stage 3 has -0.5, expected at least 0",
        ),
        ({"guidance_drop": 1.5}, "guidance_drop: got 1.5 without text_guidance, which it is taken"),
        ({"perceptual_encoder": 5}, "perceptual_encoder: got 5, expected a string"),
        ({"perceptual_encoder": None}, "perceptual_encoder: got None, expected a string"),
        ({"latents": "inverted"}, "latents: got 'inverted', expected .*'inversion'"),
        (
            {"latents": "inversion", "noise": "fresh"},
            "noise: got 'fresh' with latents 'inversion', .* set noise to 'shared'",
        ),
        (
            {"latents": "inversion", "start": (700, 980)},
            "start: got .*700, 980.* with latents 'inversion', .* set start to None",
        ),
        ({"source_prompt": "a bear"}, "source_prompt: got 'a bear' with random latents; set"),
        ({"latents": "inversion", "source_prompt": 5}, "source_prompt: got 5, expected a string"),
        ({"feature_steps": 5}, "feature_steps: got 5, expected a list"),
        ({"feature_steps": ["0", 1]}, r"feature_steps: got \['0', 1\], expected \[from, until\]"),
        ({"feature_steps": [0.5, 0.5]}, r"feature_steps: .* 0 <= from < until <= 1"),
        (
            {"feature_steps": [0.6, 0.7], "steps": 2},
            r"feature_steps: got \[0.6, 0.7\], in which none of 2 steps begins; widen it",
        ),
        ({"warp": 3, "warp.opaque": 0.9}, "warp: got 3, expected its fields by name"),
    ],
)
def test_a_wrong_setting_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        preset("corrected", **change)


def test_guidance_may_fall_to_zero():
    falling = preset("corrected", text_guidance=0.3, guidance_drop=0.1, stages=4)
    assert falling.guidance(3) == pytest.approx(0)


@pytest.mark.parametrize(("views", "each"), [(10, 3), (10, 4), (64, None), (200, None), (2, 5)])
def test_stages_are_disjoint_seeded_subsets_without_the_source(views, each):
    settings = AttentionWarpingSettings(views_per_stage=each, seed=7)
    unedited = [view for view in range(views) if view != 1]
    stages = draw_stages(unedited, settings)
    drawn = [view for stage in stages for view in stage]
    assert len(set(drawn)) == len(drawn)
    assert set(drawn) <= set(range(views)) - {1}
    expected = each or min(40, -(-(views - 1) // 3))
    left = views - 1
    for stage in stages:
        assert len(stage) == min(expected, left)
        left -= len(stage)
    assert stages == draw_stages(unedited, settings)
    if views > 2:
        assert stages != draw_stages(unedited, replace(settings, seed=8))


@pytest.mark.parametrize(
    ("targets", "sizes"),
    [
        (1, [1]),
        (4, [2, 1, 1]),
        (6, [2, 2, 2]),
        (7, [3, 2, 2]),
        (10, [4, 3, 3]),
        (119, [40, 40, 39]),
        (130, [40] * 3),
    ],
)
def test_an_equal_share_leaves_no_stage_out(targets, sizes):
    stages = draw_stages(range(1, targets + 1), AttentionWarpingSettings(seed=3))
    assert [len(stage) for stage in stages] == sizes
    order = torch.randperm(targets, generator=torch.Generator().manual_seed(3)) + 1
    drawn = [view for stage in stages for view in stage]
    assert drawn == order[: sum(sizes)].tolist()
