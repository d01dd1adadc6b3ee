"""Settings and presets."""

import json

import pytest

from attnwarp.warp.settings import PRESETS, WarpSettings, preset


def test_presets_go_through_json_and_back():
    for name, settings in PRESETS.items():
        text = json.dumps(settings.to_dict())
        assert WarpSettings.from_dict(json.loads(text)) == settings
        assert preset(name) == settings
    assert preset("released", pixel_centers="half").pixel_centers == "half"
    assert PRESETS["corrected"] == WarpSettings()
    assert WarpSettings(normal_angle=60).to_dict() == WarpSettings(normal_angle=60.0).to_dict()


def test_the_presets_are_the_table():
    paper, released, corrected = (PRESETS[name] for name in ("paper", "released", "corrected"))
    column = lambda field: tuple(getattr(p, field) for p in (paper, released, corrected))  # noqa: E731
    assert column("gaussian_filter") == ("printed", "camera_frame", "none")
    assert column("normal_test") == ("none", "none", "facing")
    assert column("bounds") == ("target", "source", "source")
    assert column("pixel_centers") == ("half", "integer", "half")
    assert column("photometric") == (None, 0.2, None)
    assert column("in_front") == (False, False, True)
    assert column("depth_agreement") == (False, False, True)
    assert column("depth") == ("intersection", "center", "intersection")
    assert column("depth_statistic") == ("expected", "expected", "median")
    assert column("mask_resize") == ("area", "bilinear", "area")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"normal_test": "face"}, r"normal_test: got 'face'.*did you mean 'facing'"),
        ({"photometric": 3}, r"photometric: got 3, expected a number in \[0, 1\]"),
        ({"depth_relative": -1}, r"depth_relative: got -1"),
        ({"depth_relative": "small"}, r"depth_relative: got 'small', expected a number"),
        ({"depth_slope": float("nan")}, r"depth_slope: got nan"),
        ({"in_front": 1}, r"in_front: got 1, expected true or false"),
        (
            {"pixel_centres": "half"},
            r"warp setting: got 'pixel_centres'.*did you mean 'pixel_centers'",
        ),
    ],
)
def test_a_wrong_setting_is_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        preset("corrected", **change)
    with pytest.raises(ValueError, match=r"preset: got 'releases'.*did you mean 'released'"):
        preset("releases")
