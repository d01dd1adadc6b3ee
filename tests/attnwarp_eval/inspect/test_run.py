"""Runs that edit scenes or fit splats: pictures of one colour, whose differences follow by hand."""

import numpy as np
import pytest
import torch
import written_runs
from tiny_scenes import splats
from typer.testing import CliRunner

from attnwarp.errors import InputError
from attnwarp.io import read_ply, write_ply
from attnwarp.warp import PRESETS
from attnwarp_eval.canonical_json import digest
from attnwarp_eval.cli.main import app
from attnwarp_eval.inspect import subject
from attnwarp_eval.inspect.scene import State
from attnwarp_eval.inspect.window import Window
from attnwarp_eval.study.probes.editing.result import EditResult, Judgement
from attnwarp_eval.study.shared.pictures import jpeg
from attnwarp_eval.study.store import Store
from attnwarp_eval.world import world

SIZE = 32
VIEW = "yaw060"
KINDS = [
    ("right", "visible"), ("wrong", "visible"), ("none", "visible"),
    ("painted_hidden", "hidden"), ("painted_outside", "outside"),
]  # fmt: skip
COLORS = {
    "before": (0.2, 0.2, 0.2),
    "source-edit": (0.8, 0.2, 0.2),
    "edited": (0.6, 0.2, 0.2),
    "render": (0.2, 0.6, 0.2),
    "truth": (0.2, 0.2, 0.8),
}
STUDY = {
    "name": "edits",
    "scenes": ["spheres"],
    "size": SIZE,
    "seeds": [3, 4],
    "splats": {"count": 500},
    "views": [VIEW, "yaw120"],
    "variants": {"oracle": {"mask": "truth"}, "fitted": {"fitted": True}},
    "probes": {"editing": ["oracle", "fitted"]},
}


def make(folder, content=None, view=VIEW, settings=None):
    """A run with an edit of one view by the variant "oracle", and one on fitted splats that has no
    pictures."""
    store = Store(folder)
    common = {
        "probe": "editing",
        "scene": content or world("spheres", SIZE).content_hash,
        "size": SIZE,
        "spp": 8,
        "seed": 3,
        "edit": {"name": "red"},
        "geometry": "splats",
    }
    settings = settings or {"warp": PRESETS["paper"].to_dict()}
    specs = {
        "oracle": {**common, "mask": "truth", "settings": settings},
        "fitted": {**common, "mask": "rules", "settings": {}, "fit": {"views": 9}},
    }
    judged = Judgement("red", True, 30.0, 10.0, 10.0)
    extra = EditResult("red", "make it red", judged, judged, {}, {}, 30.0, 1, 0.5).to_json()
    cells = []
    for name, spec in specs.items():
        record = {**written_runs.record([], spec=spec, **extra), "id": digest(spec)}
        if name == "oracle":
            for what, color in COLORS.items():
                path = store.pictures / "a" / f"{VIEW}-{what}.jpg"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(jpeg(np.full((64, 64, 3), color, np.float32)))
                record["pictures"].append(store.keep_picture(path, view=f"red/{view}", what=what))
        store.write(record)
        cells.append(
            {"id": record["id"], "title": name, "scene": "spheres", "variants": [name]}
            | {"probe": "editing", "seed": 3}
        )
    store.write_study({"study": STUDY, "scenes": {}, "cells": cells})
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make(tmp_path_factory.mktemp("edits") / "run")


@pytest.fixture(scope="module")
def edited(run):
    return subject.of_run(run)


def test_an_edited_view_of_a_run_has_its_pictures_settings_and_mask(edited):
    assert edited.targets == (f"red/{VIEW}", VIEW, "yaw120")
    assert edited.steps == ("before", "edited")
    assert edited.preferred == "oracle"
    pair = edited.pair("oracle", edited.targets[0])
    assert pair.target == VIEW and pair.settings == PRESETS["paper"]
    visible = torch.from_numpy(pair.truth.visible) & pair.view.correspondence.defined
    assert visible.any() and torch.equal(pair.view.mask, visible)
    insets = pair.insets(step="edited")
    # A flat JPEG is within one level of its colour.
    for title, what in {
        "source, edited": "source-edit",
        "target, edited": "edited",
        "scene, edited": "render",
        "true edit": "truth",
    }.items():
        assert abs(insets[title] - np.float32(COLORS[what])).max() < 0.01, title


def test_disagreement_of_edited_views_is_the_difference_of_their_colours(edited):
    pair = edited.pair("oracle", edited.targets[0])
    mask = pair.view.mask.numpy()
    # Of three channels, red alone differs, by 0.2.
    assert pair.disagreement[mask] == pytest.approx(0.2 / 3, abs=0.01)
    assert np.isnan(pair.disagreement[~mask]).all()
    assert "edit disagreement" not in edited.pair("oracle", VIEW).colorings


def test_fitted_splats_are_read_from_the_run(run, edited):
    with pytest.raises(InputError, match="fitted splats cannot be shown; open another --variant"):
        edited.pair("fitted", VIEW)
    file = edited.measured["fitted"].fit
    file.parent.mkdir(parents=True)
    write_ply(file, splats())
    model = edited.pair("fitted", VIEW).model
    assert torch.equal(model.sh, read_ply(file).sh)


def test_the_window_of_an_edit_shows_every_inset_once_its_slider_is_at_edited(edited):
    state = State("oracle", edited.targets[0], step="before")
    window = Window(edited, state, off_screen=True, size=(600, 360))
    try:
        window._add_sliders()
        slider = window._sliders["step"][0]
        slider.GetRepresentation().SetValue(1)
        slider.InvokeEvent("EndInteractionEvent")
        image = window.plotter.screenshot(return_img=True)[..., :3] / 255
    finally:
        window.close()
    for what in ("source-edit", "edited", "render", "truth"):
        assert (abs(image - COLORS[what]).max(axis=2) < 0.02).mean() > 0.003, what


@pytest.mark.parametrize(
    "options",
    [
        ["--view", "yaw120", "--color", "edit disagreement"],
        ["--view", f"red/{VIEW}", "--variant", "fitted", "--color", "edit disagreement"],
        ["--view", "yaw120", "--step", "edited"],
    ],
)
def test_an_edited_view_without_pictures_names_what_to_open(run, edited, options):
    file = edited.measured["fitted"].fit
    file.parent.mkdir(parents=True, exist_ok=True)
    write_ply(file, splats())
    result = CliRunner().invoke(app, ["inspect", str(run), *options])
    assert result.exit_code == 2, result.output
    assert f"edited views red/{VIEW} by the variants 'oracle' alone" in result.stderr
    assert "attnwarp edit" in result.stderr


def test_a_run_without_edits_is_not_shown_on_a_scene_that_has_changed(tmp_path):
    """Oracle: the hash of the scene that ships, and another."""
    now = world("spheres", SIZE).content_hash
    study = STUDY | {"views": [], "variants": {"plain": {}}, "probes": {"warp": ["plain"]}}
    for content in (now, "0" * 64):
        store = Store(tmp_path / content[:4])
        spec = {"probe": "warp", "scene": content, "size": SIZE, "spp": 1, "seed": 3}
        record = {**written_runs.record([], spec=spec), "id": digest(spec)}
        store.write(record)
        cell = {"id": record["id"], "title": "plain", "scene": "spheres", "variants": ["plain"]}
        cells = [cell | {"probe": "warp", "seed": 3}]
        store.write_study({"study": study, "scenes": {}, "cells": cells})
        if content == now:
            assert subject.of_run(store.root).measured == {}
            continue
        with pytest.raises(InputError, match="'spheres' has changed since the run was made"):
            subject.of_run(store.root)


@pytest.mark.door
def test_runs_that_do_not_fit_and_damaged_ones_are_refused(tmp_path):
    run = make(tmp_path / "changed", content="0" * 64)
    with pytest.raises(InputError, match="'spheres' has changed since the run was made"):
        subject.of_run(run)
    with pytest.raises(InputError, match=r"seed: got '5'.*expected one of 3, 4"):
        subject.of_run(run, seed=5)
    assert subject.of_run(run, seed=4).targets == (VIEW, "yaw120")
    run = make(tmp_path / "view", view="yaw999")
    with pytest.raises(InputError, match="picture of the view: got 'yaw999'"):
        subject.of_run(run)
    run = make(tmp_path / "settings", settings={"warp": 7})
    with pytest.raises(InputError, match="not a record of its probe"):
        subject.of_run(run)
    run = make(tmp_path / "damaged")
    (run / f"pictures/a/{VIEW}-edited.jpg").write_bytes(b"")
    with pytest.raises(InputError, match="changed since it was written"):
        subject.of_run(run).pair("oracle", f"red/{VIEW}").insets()
