"""Oracle: loops over pixels; skimage's CIEDE2000 is the field's."""

import math

import numpy as np
from skimage.color import deltaE_ciede2000, rgb2lab

from attnwarp_lab.ideal.figures import PartTruth, fill_figures, part_answers, part_figures

RANDOM = np.random.default_rng(0)


def truth():
    """A view of 16 x 16 px: three parts in columns, nothing in the last."""
    before = RANDOM.random((16, 16, 3)).astype(np.float32)
    after = np.stack([np.full((16, 16, 3), level, np.float32) for level in (0.1, 0.5, 0.9)])
    pixels = np.repeat(np.array([0, 1, 2, -1], np.int16), 4)[None].repeat(16, axis=0)
    tokens = np.array([[0, 1, 2, -1]] * 4, np.int16)
    pixels[0, 3] = 1  # of another part than its token's
    return PartTruth.of(before, after, pixels, tokens)


def test_figures_are_those_of_a_loop_over_pixels():
    of = truth()
    levels = np.array([0.12, 0.48, 0.55, 0.3])  # answers 0, 1 and 1; outside nothing of the kind
    picture = (
        np.repeat(levels, 4)[None, :, None].repeat(16, axis=0).repeat(3, axis=2).astype(np.float32)
    )
    picture[12:, :4] = 0.9  # hidden pixels of part 0 show the answer of part 2, before them
    answers = np.array([0, 1, 2])
    visible = np.zeros((16, 16), bool)
    visible[:12] = True
    before_it = np.where(~visible, 2, -1).astype(np.int16)
    got = part_figures(picture, of, answers, visible, ~visible, before_it)

    assert part_answers(picture, of, 3, visible).tolist() == [0, 1, 1]
    assert got["parts.seen"] == 2 / 3 and got["parts.seen_parts"] == 3
    asked = through = 0
    errors, bleed = [], []
    for y in range(16):
        for x in range(16):
            part = of.pixels[y, x]
            if part < 0:
                if x >= 12:
                    bleed.append(
                        deltaE_ciede2000(
                            *(rgb2lab(p[y, x].astype(float)) for p in (picture, of.before))
                        )
                    )
            elif visible[y, x]:
                true = of.after[answers[part], y, x].astype(float)
                errors.append(deltaE_ciede2000(rgb2lab(picture[y, x].astype(float)), rgb2lab(true)))
            elif part != 2:
                asked += 1
                through += np.abs(picture[y, x, 0] - np.array([0.1, 0.5, 0.9])).argmin() == 2
    assert (
        got["parts.hidden_pixels"] == asked == 32 and got["parts.through"] == through / asked == 0.5
    )
    assert math.isclose(got["parts.delta_e"], float(np.mean(errors)), rel_tol=1e-6)
    assert math.isclose(got["parts.bleed"], float(np.mean(bleed)), rel_tol=1e-6)


def test_a_part_of_fewer_pixels_than_a_token_has_no_answer():
    of = truth()
    few = np.zeros((16, 16), bool)
    few[:4, 4:8] = True  # 16 px of part 1
    few[:3, 8:12] = True  # 12 px of part 2
    assert part_answers(of.after[0], of, 3, few).tolist() == [-1, 0, -1]


def test_where_nothing_is_seen_or_hidden_figures_are_undefined():
    of = truth()
    nothing = np.zeros((16, 16), bool)
    got = part_figures(
        of.before, of, np.array([0, 0, 0]), nothing, nothing, np.full((16, 16), -1, np.int16)
    )
    assert (
        math.isnan(got["parts.seen"])
        and math.isnan(got["parts.through"])
        and math.isnan(got["parts.delta_e"])
    )
    assert got["parts.bleed"] == 0.0


def test_targets_are_held_against_each_other_on_what_the_source_does_not_show():
    """Oracle: pairs counted one by one."""
    random = np.random.default_rng(0)
    answers = np.repeat([-1, 1], 6)
    shown = {name: random.integers(-1, 3, 12) for name in "abcd"}
    got = fill_figures(shown, answers)
    for name, mine in shown.items():
        pairs = [
            (mine[part], other[part])
            for key, other in shown.items()
            for part in range(12)
            if key != name and answers[part] == -1 and mine[part] >= 0 and other[part] >= 0
        ]
        assert got[name]["parts.fill_pairs"] == len(pairs) > 0
        assert got[name]["parts.fill"] == np.mean([a == b for a, b in pairs])
    assert np.isnan(fill_figures(shown, np.zeros(12, int))["a"]["parts.fill"])
