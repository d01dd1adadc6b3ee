import numpy as np
import pytest
import skimage.color

from attnwarp_eval.colors import to_linear, to_srgb
from attnwarp_eval.scene.textures import (
    Bricks,
    Cells,
    Checker,
    Noise,
    Plain,
    Stripes,
    albedo,
    fractal_noise,
    linear_rgb,
)


def test_the_srgb_curve_is_the_one_of_the_standard():
    values = np.linspace(0, 1, 1001)
    # skimage's rgb2xyz linearises with the curve of IEC 61966-2-1; grey of linear value v has Y =
    # v.
    grey = np.repeat(values[:, None], 3, axis=1)
    assert np.abs(skimage.color.rgb2xyz(grey)[:, 1] - to_linear(values)).max() < 1e-6
    assert np.abs(to_srgb(to_linear(values)) - values).max() < 1e-7
    assert to_srgb(np.float32([0.5])).dtype == np.float32
    assert to_srgb([-1.0, 2.0]).tolist() == pytest.approx([0.0, 1.0], abs=1e-15)


def test_a_checker_changes_colour_from_cube_to_cube_but_not_within_a_floor():
    texture = Checker(type="checker", colors=("#000000", "#ffffff"), size=0.5)
    points = np.random.default_rng(0).uniform(-3, 3, (2000, 3))
    step = np.array([0.5, 0, 0])
    assert not np.isclose(albedo(texture, points), albedo(texture, points + step)).any()
    # A floor at z = 0 lies within a layer of cubes, whatever the rounding of z.
    points[:, 2] = 0
    assert np.array_equal(albedo(texture, points), albedo(texture, points + np.array([0, 0, 1e-9])))
    assert np.array_equal(albedo(texture, points), albedo(texture, points - np.array([0, 0, 1e-9])))


@pytest.mark.parametrize(
    "texture",
    [
        Plain(color="#336699", variation=0.5),
        Checker(type="checker", colors=("#102030", "#fff0e0"), size=0.3),
        Stripes(type="stripes", colors=("#102030", "#fff0e0", "#ff0000"), size=0.2, wobble=0.5),
        Noise(type="noise", colors=("#102030", "#fff0e0"), size=0.4),
        Bricks(type="bricks", colors=("#a05040",), mortar="#cccccc", size=(0.6, 0.2)),
        Cells(type="cells", centers=((0, 0, 0), (1, 1, 0)), colors=("#a05040", "#20c030")),
    ],
)
def test_an_albedo_is_a_function_of_the_point_alone_and_physical(texture):
    points = np.random.default_rng(1).normal(size=(3000, 3)) * 4
    color = albedo(texture, points)
    assert color.min() >= 0 and color.max() <= 0.9
    order = np.random.default_rng(2).permutation(3000)
    assert np.array_equal(albedo(texture, points[order]), color[order])
    assert color.std() > 0.02  # something to see


def test_cells_have_the_colour_of_their_nearest_centre_far_from_the_origin_too():
    rng = np.random.default_rng(8)
    centers, points = rng.normal(size=(12, 3)) + 1e5, rng.normal(size=(500, 3)) + 1e5
    colors = tuple(f"#{k:02x}8040" for k in range(12))
    texture = Cells(type="cells", centers=tuple(map(tuple, centers)), colors=colors)
    nearest = np.linalg.norm(points[:, None] - centers[None], axis=-1).argmin(axis=1)
    expected = [linear_rgb(colors[k]) for k in nearest]
    assert np.allclose(albedo(texture, points), np.minimum(expected, 0.9))
    with pytest.raises(ValueError, match="got 11 colors for 12 centers"):
        Cells(type="cells", centers=texture.centers, colors=colors[:-1])


def test_noise_is_smooth_spread_about_a_half_and_the_same_everywhere():
    points = np.random.default_rng(3).normal(size=(50_000, 3)) * 30
    value = fractal_noise(points, 4, 3)
    assert (
        value.min() >= 0
        and value.max() <= 1
        and abs(value.mean() - 0.5) < 0.01
        and value.std() > 0.1
    )
    nudged = fractal_noise(points + 1e-6, 4, 3)
    # Slope of an octave at most 15/8 per cell, doubled in frequency and halved in weight each time.
    assert np.abs(nudged - value).max() < 3 * 4 * 15 / 8 * 1e-6
    # A pinned value: the textures are part of a scene's content, so another machine must agree.
    assert fractal_noise(np.array([[0.25, -3.5, 7.125]]), 3, 7)[0] == pytest.approx(
        PINNED, abs=1e-15
    )


PINNED = 0.607609580499665


def test_colours_are_srgb_in_quotes():
    assert np.allclose(linear_rgb("#ffffff"), 1) and np.allclose(
        linear_rgb("#808080"), 0.21586, atol=1e-5
    )
    with pytest.raises(ValueError, match="unquoted # starts a YAML comment"):
        Plain(color=None)
    with pytest.raises(ValueError, match="expected an sRGB colour in quotes such as"):
        Plain(color="red")
