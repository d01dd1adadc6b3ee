"""Oracles: the true pictures themselves."""

import numpy as np
import pytest
from tiny_scenes import cameras, pictures, splats

from attnwarp.editing.small import load_editor
from attnwarp.encoders import load_encoder
from attnwarp.methods import Budget
from attnwarp.warp import WarpSettings
from attnwarp_eval.study import parse_study
from attnwarp_eval.study.shared import edits
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS, Donor, Job


def test_true_pictures_are_the_edits_of_their_views(tmp_path):
    model, views = splats(), cameras(3)
    images = pictures(model, views)
    truth = [1 - image for image in images]
    method = EDITING_METHODS["true pictures"]
    settings = method.settings(None, {"stages": 1, "iterations": 1, "size": 16}, 0)
    editor = load_editor("small-plain")
    done = method.run(
        Job(model, views, images, editor, "red", settings, tmp_path, None, {"red": truth})
    )
    assert len(done.edited) == 3
    for view, edited in done.edited.items():
        assert np.abs(edited / 255.0 - truth[view].clip(0, 1)).max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize("name", ["true pictures", "attention_warping"])
def test_a_bound_and_a_control_keep_to_the_mask_and_start_at_the_source(name, tmp_path):
    """By attention warping with features of another picture, and with true pictures."""
    model, views = splats(), cameras(3)
    images, editor, half = pictures(model, views), load_editor("small-plain"), np.zeros((32, 32))
    half[:, :16] = 1
    loaded = []

    def load(*names, **more):
        loaded.append(names)
        return load_encoder(*names, **more)

    method = EDITING_METHODS[name]
    settings = method.settings(None, {"stages": 1, "steps": 1, "iterations": 1}, 0)
    job = Job(
        model, views, images, editor, "red", settings, tmp_path, None,
        {"red": [1 - image for image in images]},
        donor=Donor(editor, images[0]) if name == "attention_warping" else None,
        segments=[half > 0] * 3, source=1, load=load,
    )  # fmt: skip
    done = method.run(job)
    assert next(iter(done.edited)) == 1 and len(done.edited) == 3 and loaded
    for view, edited in done.edited.items():
        before = np.rint(255 * images[view])
        assert np.abs(edited - before)[:, 16:].max() <= 1 < np.abs(edited - before)[:, :16].max()


@pytest.mark.parametrize("name", ["budget", "donor"])
def test_true_pictures_refuse_what_they_make_nothing_of(name, tmp_path):
    given = {"budget": Budget(seconds=1), "donor": Donor(None, None)}
    job = Job(None, [], [], None, "red", {}, tmp_path, None, {"red": []}, **{name: given[name]})
    with pytest.raises(ValueError, match=f"{name}: got one, but 'true pictures' edits nothing"):
        EDITING_METHODS["true pictures"].run(job)


@pytest.mark.parametrize(
    ("method", "name", "expected"),
    [
        ("igs2gs", "released", {"text_guidance": 12.5, "image_guidance": 1.5, "iterations": 7500}),
        ("igs2gs", "improved", {"text_guidance": 12.5, "image_guidance": 1.5, "iterations": 3000}),
        ("dge", "released", {"text_guidance": 7.5, "image_guidance": 1.5}),
        ("gaussctrl", "paper", {"text_guidance": 5.0, "control_share": None}),
        ("gaussctrl", "released", {"text_guidance": 5.0, "control_share": 0.0}),
        ("igs2gs", None, {"text_guidance": None, "image_guidance": None}),
    ],
)
def test_a_variant_has_the_preset_of_its_method_that_it_names(method, name, expected):
    """The published numbers of docs/method/baselines.md."""
    variant = {"method": method} | ({} if name is None else {"preset": name})
    study = parse_study(
        {"name": "s", "scenes": ["bear"], "variants": {"v": variant}, "probes": {"editing": ["v"]}}
    )
    settings = edits.settings_of(study, study.variants["v"], 0)
    assert {key: settings[key] for key in expected} == expected


def test_a_variants_dictionary_changes_the_studys():
    study = parse_study({
        "name": "one", "scenes": ["bear"], "editing": {"options": {"warp": {"opaque": 0.9}}},
        "variants": {"v": {"options": {"warp": {"normal_angle": 30}}, "set": {"depth": "center"}}},
        "probes": {"editing": ["v"]},
    })  # fmt: skip
    warp = edits.settings_of(study, study.variants["v"], 0)["warp"]
    given = {"opaque": 0.9, "normal_angle": 30, "depth": "center"}
    assert warp == {**WarpSettings().to_dict(), **given}
