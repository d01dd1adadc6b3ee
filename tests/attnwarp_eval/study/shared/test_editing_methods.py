"""Oracles: the true pictures themselves."""

import numpy as np
import pytest
from tiny_scenes import cameras, pictures, splats

from attnwarp.editing.small import load_editor
from attnwarp_eval.study import parse_study
from attnwarp_eval.study.shared import edits
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS, Job


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
