"""Settings and presets."""

import dataclasses
import json
import re
from pathlib import Path

import pytest
import torch
from closed_forms import orbit, shell

from attnwarp.warp.settings import PRESETS, WarpSettings, preset
from attnwarp.warp.view import warp_view


def test_presets_go_through_json_and_back():
    for name, settings in PRESETS.items():
        text = json.dumps(settings.to_dict())
        assert WarpSettings.from_dict(json.loads(text)) == settings
        assert preset(name) == settings
    assert preset("released", pixel_centers="half").pixel_centers == "half"
    assert PRESETS["corrected"] == WarpSettings()
    assert WarpSettings(normal_angle=60).to_dict() == WarpSettings(normal_angle=60.0).to_dict()


def test_the_presets_are_the_table_of_the_docs():
    text = (Path(__file__).parents[3] / "docs/method/warping.md").read_text("utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (\S+) \| (\S+) \| (\S+) \| (\S+) \|$", text, re.MULTILINE)
    documented = {name: cells for name, *cells in rows}
    written = {None: "none", True: "true", False: "false"}
    for field in dataclasses.fields(WarpSettings):
        values = [getattr(settings, field.name) for settings in PRESETS.values()]
        if field.name in documented:
            assert [written.get(value, str(value)) for value in values] == documented[field.name]
        else:
            assert len(set(values)) == 1, field.name
    assert set(documented) <= {field.name for field in dataclasses.fields(WarpSettings)}


@pytest.mark.parametrize("name", ["depth_spread", "depth_relative", "depth_slope", "opaque"])
@pytest.mark.parametrize("value", [float("inf"), float("nan"), -1.0, True, "1"])
def test_a_limit_that_no_file_could_hold_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=rf"{name}: got .*, expected a number"):
        preset("corrected", **{name: value})


def test_every_field_changes_what_it_says():
    """A field that nothing reads could hold any value: each changed alone moves a result."""
    splats, source, target = shell(3000), orbit(0, size=40), orbit(50, size=40, height=0.8)
    segment = torch.zeros(40, 40, dtype=torch.bool)
    segment[:, 18:] = True
    # Two bare rules, so that no other one hides what a field does.
    bare = preset("released", photometric=None, segment=False, gaussian_filter="none")
    agreement, incidence = {"depth_agreement": True}, {"normal_test": "source_incidence"}
    changes = {
        "pixel_centers": ("half", {}),
        "bounds": ("target", {}),
        "in_front": (True, {}),
        "opaque": (0.9, {}),
        "depth_agreement": (True, {}),
        "depth_relative": (0.3, agreement),
        "depth_slope": (5.0, agreement),
        "photometric": (0.02, {}),
        "segment": (True, {}),
        "normal_test": ("facing", {}),
        "gaussian_filter": ("camera_frame", {}),
        "normal_angle": (20.0, incidence),
        "depth": ("intersection", {}),
        "depth_statistic": ("median", {}),
        "undefined_depth": ("none", {}),
        "depth_interpolation": ("nearest", {}),
        "depth_spread": (0.001, {}),
        "mask_resize": ("nearest", {}),
    }
    assert set(changes) == {field.name for field in dataclasses.fields(WarpSettings)}

    def result(settings, views):
        edited = segment if settings.segment else None
        view = warp_view(splats, *views, settings, target_segment=edited)
        layer = view.at((13, 13), source_size=(13, 13))
        parts = (view.correspondence.xy, view.mask, layer.correspondence.xy, layer.mask)
        return [torch.nan_to_num(part.double()) for part in parts]

    # The source stands inside the sphere in one pair, and is larger than the target in another.
    pairs = [
        (source, target),
        (orbit(0, size=40, distance=0.5), target),
        (source.resize(60, 60), target),
    ]
    for name, (value, needs) in changes.items():
        start = dataclasses.replace(bare, **needs)
        changed = dataclasses.replace(start, **{name: value})
        before, after = (
            [result(settings, views) for views in pairs] for settings in (start, changed)
        )
        same = all(
            torch.equal(a, b)
            for one, other in zip(before, after, strict=True)
            for a, b in zip(one, other, strict=True)
        )
        assert not same, name


@pytest.mark.door
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
            r"setting: got 'pixel_centres'.*did you mean 'pixel_centers'",
        ),
    ],
)
def test_a_wrong_setting_is_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        preset("corrected", **change)
    with pytest.raises(ValueError, match=r"preset: got 'releases'.*did you mean 'released'"):
        preset("releases")


@pytest.mark.door
def test_an_unknown_name_of_any_table_lists_the_known_ones_and_the_nearest():
    from attnwarp import methods

    for table, wrong, right in (
        (PRESETS, "correct", "corrected"),
        (methods.PRESETS, "attention_warp", "attention_warping"),
        (methods.PRESETS["igs2gs"], "improve", "improved"),
        (methods.METHODS, "gausctrl", "gaussctrl"),
    ):
        with pytest.raises(KeyError, match=f"got '{wrong}', expected one of .*'{right}'"):
            table[wrong]
        assert table.get(wrong) is None and right in table
