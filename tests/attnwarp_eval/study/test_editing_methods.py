"""Oracles: the true pictures themselves, averaged by OpenCV."""

import cv2
import numpy as np
import pytest
from tiny_scenes import cameras, pictures, splats

from attnwarp.editing.small import load_editor
from attnwarp_eval.study.editing_methods import EDITING_METHODS, Job


@pytest.mark.parametrize(("detail", "size"), [("none", 16), ("none", None), ("change", 16)])
def test_true_pictures_have_the_size_at_which_other_methods_edit(detail, size, tmp_path):
    model, views = splats(), cameras(3)
    images = pictures(model, views)
    truth = [1 - image for image in images]
    method = EDITING_METHODS["true pictures"]
    fields = {"stages": 1, "iterations": 1, "detail": detail, "size": size}
    settings = method.settings(None, fields, 0)
    editor = load_editor("small-plain")
    done = method.run(
        Job(model, views, images, editor, "red", settings, tmp_path, None, {"red": truth})
    )
    edge = images[0].shape[0] if detail == "change" else size or images[0].shape[0]
    assert len(done.edited) == 3
    for view, edited in done.edited.items():
        how = cv2.INTER_AREA if edge < images[0].shape[0] else cv2.INTER_CUBIC
        expected = cv2.resize(truth[view], (edge, edge), interpolation=how)
        assert np.abs(edited / 255.0 - expected.clip(0, 1)).max() <= 0.5 / 255 + 1e-6
    assert {"options.detail", "options.size"} <= method.reads(settings) or detail == "change"
