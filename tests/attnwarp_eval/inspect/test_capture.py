"""A user's own scene and an edit of it, against the library; hostile folders."""

import json
import shutil

import numpy as np
import pytest
import torch

from attnwarp.errors import InputError
from attnwarp.io import read_image, read_ply
from attnwarp.render import render
from attnwarp.warp import PRESETS, sample, warp_view
from attnwarp_eval.files import write_picture
from attnwarp_eval.inspect import subject
from attnwarp_eval.inspect.capture import Capture, Edit, read_edit
from attnwarp_eval.inspect.pixel import report
from attnwarp_eval.inspect.window import plain


@pytest.fixture(scope="module")
def own(folders):
    return subject.of_capture(folders / "scene.ply", folders)


@pytest.fixture(scope="module")
def edited(folders):
    return subject.of_capture(folders / "edit", folders, ply=folders / "scene.ply")


def test_a_users_scene_is_warped_as_the_library_warps_it(own, folders):
    pair = own.pair("corrected", "3")
    model = read_ply(folders / "scene.ply")
    source, target = pair.cameras
    assert (source.name, target.name) == ("0", "3")
    view = warp_view(model, source, target, PRESETS["corrected"])
    assert torch.equal(view.mask, pair.view.mask) and pair.truth is None
    assert pair.images[1] == pytest.approx(read_image(folders / "images" / "3.png") / 255, abs=1e-6)
    depth = render(model, target).median_depth
    for column, row in np.random.default_rng(0).integers(0, 32, (20, 2)).tolist():
        result = report(pair, column, row)
        np.testing.assert_equal(result.xy, view.correspondence.xy[row, column].numpy())
        np.testing.assert_equal(result.depths["intersection, median"], float(depth[row, column]))
        assert result.exact is None and "endpoint" not in "".join(result.lines())
    assert set(pair.colorings) == {"picture", "mask", "rules", "incidence"}


def test_the_centre_is_where_the_cameras_look_and_up_is_theirs(own):
    # The cameras stand on a line at z = 3 and look at (x / 2, 0, 0): their axes meet at z = -3.
    assert own.center == pytest.approx([0, 0, -3], abs=1e-6)
    assert own.up == pytest.approx([0, 1, 0], abs=1e-6)
    # A hundredth of 1.1 times the largest distance from the cameras' mean: they end at x = -0.8, 0.8.
    assert own.pair("corrected", "3").views.near == pytest.approx(0.01 * 1.1 * 0.8, abs=1e-6)


def test_what_stands_before_a_point_comes_from_the_sources_own_depth(own):
    pair = own.pair("paper", "4")
    pair = type(pair)(pair.views, "4", PRESETS["corrected"], pair.model)
    surface = pair.surfaces[0]
    near = np.asarray(surface.depth).copy() * 0.5
    closer = type(surface)(near, surface.normal, surface.alpha, surface.image)
    pair.__dict__["surfaces"] = (closer, pair.surfaces[1])
    accepted = np.argwhere(pair.view.correspondence.defined.numpy())
    hidden = [report(pair, int(c), int(r)) for r, c in accepted[::37]]
    seen = [result for result in hidden if result.seen_instead is not None]
    assert len(seen) > 3
    for result in seen:
        # On the ray to the point, at half its depth.
        xy, z = pair.cameras[0].project(result.seen_instead)
        assert xy == pytest.approx(result.xy, abs=1e-6)
        assert z == pytest.approx(result.source_depth)


def test_an_edit_shows_its_own_files_and_settings(edited, folders):
    manifest = json.loads((folders / "edit/manifest.json").read_text())
    pair = edited.pair(subject.EDIT_VARIANT, edited.targets[0])
    assert pair.settings.to_dict() == manifest["settings"]["warp"]
    assert edited.preferred == subject.EDIT_VARIANT
    assert edited.edit.steps == ("before", "stage 1", "edited")
    first = [name for part in manifest["rounds"] for name in part["views"]][1:]
    assert set(edited.targets[: len(first)]) == set(first)
    name = edited.targets[0]
    insets = pair.insets()
    picture = read_image(folders / f"edit/views/{name}.png") / 255
    assert insets["target, edited"] == pytest.approx(picture, abs=1e-6)
    after = read_image(folders / f"edit/renders/after/{name}.png") / 255
    assert pair.picture("edited") == pytest.approx(after, abs=1e-6)
    stage = render(read_ply(folders / "edit/rounds/1.ply"), pair.cameras[1]).color.clamp(0, 1)
    assert pair.picture("stage 1") == pytest.approx(stage.numpy(), abs=1e-6)
    assert torch.equal(edited.edit.splats("edited").sh, read_ply(folders / "edit/edited.ply").sh)


def test_disagreement_is_the_difference_of_the_edits_along_the_warp(edited, folders):
    name = edited.targets[0]
    pair = edited.pair(subject.EDIT_VARIANT, name)
    place = folders / f"edit/views/{edited.edit.source}.png"
    source = torch.as_tensor(read_image(place) / 255).permute(2, 0, 1)
    target = read_image(folders / f"edit/views/{name}.png") / 255
    warped = sample(source, pair.view.correspondence)[0].permute(1, 2, 0).numpy()
    expected = abs(warped - target).mean(axis=2)
    mask = pair.view.mask.numpy()
    assert mask.any()
    assert pair.disagreement[mask] == pytest.approx(expected[mask], abs=1e-6)
    assert np.isnan(pair.disagreement[~mask]).all()
    assert "edit disagreement" in pair.colorings


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"source": "elsewhere"}, "view 'elsewhere', which DATA has"),
        ({"rounds": 7}, "not the manifest of an edit"),
        ({"settings": {}}, "not the manifest of an edit"),
    ],
)
def test_a_manifest_of_something_else_is_refused(folders, tmp_path, change, message):
    manifest = json.loads((folders / "edit/manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps(manifest | change))
    with pytest.raises(InputError, match=message):
        read_edit(tmp_path, [str(k) for k in range(5)])


def test_inspecting_an_edit_writes_nothing_to_its_folder(folders, tmp_path):
    shutil.copytree(folders / "edit", tmp_path / "edit")
    (tmp_path / "edit/masks").rename(tmp_path / "edit/gone")
    before = sorted(tmp_path.rglob("*"))
    chosen = subject.of_capture(tmp_path / "edit", folders, ply=folders / "scene.ply")
    chosen.pair(subject.EDIT_VARIANT, chosen.targets[0]).insets(None, "stage 1")
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.door
def test_what_is_missing_is_named_with_the_remedy(folders, tmp_path):
    for arguments, message in (
        ((folders / "edit", folders), "name them with --ply FILE.ply"),
        ((tmp_path, folders), r"expected splats \(.*\) or a folder of attnwarp edit"),
    ):
        with pytest.raises(InputError, match=message):
            subject.of_capture(*arguments)
    with pytest.raises(InputError, match="source: got '9'"):
        subject.of_capture(folders / "scene.ply", folders, source="9")
    with pytest.raises(InputError, match="expected at least a source and a target"):
        data = subject.read_dataset(folders)
        one = type(data)(data.cameras[:1], data.image_paths[:1])
        Capture(read_ply(folders / "scene.ply"), one)


def test_names_are_drawn_as_they_stand():
    assert plain("a\x1b[2Jb\x00$x^2$\u202e") == "a?[2Jb?\\$x^2\\$?"
    assert len(plain("x" * 10_000)) == 120


def test_a_view_that_later_rounds_edit_again_is_shown_as_the_last_one_left_it(tmp_path):
    for number in (1, 2, 10):
        place = tmp_path / f"rounds/{number}/a.png"
        place.parent.mkdir(parents=True)
        write_picture(place, np.full((4, 4, 3), number, dtype=np.uint8))
    shown = Edit(tmp_path, "", "0", ("a",), PRESETS["corrected"], ()).edited("a")
    assert np.rint(255 * shown).max() == 10
