"""Files of scenes that are changed under a worker that lives on. Oracle: the colours that were written."""

import numpy as np
import pytest
import yaml
from ball_scene import ball_scene

from attnwarp.errors import InputError
from attnwarp_eval.study import Store, parse_study
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probes.editing import measure as editing
from attnwarp_eval.study.probes.timing import measure as timing
from attnwarp_eval.study.run import plan
from attnwarp_eval.study.shared.edit_truth import edit_truth
from attnwarp_eval.study.work import compute
from attnwarp_eval.world import splats, world

CAMERAS = {"look_at": [0, 0, 0.8], "radius": 3.5, "targets": (15, 30)}
RED, BLUE = "#ff0000", "#0000ff"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "ball.yaml"


def write(path, paint, ball="#808080"):
    """A ball and its edit; its colour before the edit is no part of the edited scene."""
    edit = {
        "name": "paint",
        "instruction": "paint it",
        "source": "a ball",
        "target": "a painted ball",
        "changes": [
            {"object": "ball", "texture": {"type": "plain", "color": paint, "variation": 0}}
        ],
    }
    scene = ball_scene("A ball", 0.9, (ball, ball), CAMERAS, [edit])
    path.write_text(yaml.safe_dump(scene))


def planned(path, kind, root):
    study = {
        "name": "mine",
        "size": 16,
        "scenes": [str(path)],
        "seeds": [0, 1],
        "spp": 1,
        "views": ["yaw015", "yaw030"],
        "variants": {"alone": {"method": "by_view"}, "more": {"method": "igs2gs"}},
        "probes": {"editing": ["alone", "more"]} | {kind: ["alone", "more"]},
    }
    cells = plan(parse_study(study), Store(root)).cells
    return next(cell for cell in cells if cell.probe == kind)


@pytest.mark.parametrize("kind", ["editing", "timing"])
def test_a_cell_of_an_edit_that_the_file_no_longer_has_is_refused(
    path, tmp_path, kind, monkeypatch
):
    def computed(*_):
        raise AssertionError("the cell goes on behind its truth")

    for module in (editing, timing):
        monkeypatch.setattr(module, "splats_of", computed)
    write(path, RED)
    cell = planned(path, kind, tmp_path / "run")
    world(cell.scene_file, 16)
    write(path, BLUE)
    with pytest.raises(InputError, match="edit 'paint' of scene .* start the run again"):
        compute(probe(kind), cell, tmp_path / "run")


def test_truths_and_splats_are_those_of_the_file_as_it_is(path, coarse_textures):
    def colors():
        truth = edit_truth(str(path), 16, 1, "paint", ("source", "yaw015"))
        inside = truth.masks["edited"]["source"]
        pictures = (truth.answers["edited"]["source"], truth.originals["source"])
        return [np.argmax(picture[inside].mean(0)) for picture in pictures]

    def splat_color():
        settings = {"kind": "2d", "count": 300, "position_noise": 0.0, "normal_noise": 0.0}
        sh = splats(str(path), 16, 0, **settings).sh[:, 0]
        return sh[:, 0].max() > sh[:, 1].max()

    write(path, RED, ball="#00ff00")
    assert colors() == [0, 1]
    assert not splat_color()
    write(path, BLUE, ball="#00ff00")
    assert colors() == [2, 1]
    write(path, BLUE, ball="#ff0000")
    assert colors() == [2, 0]
    assert splat_color()
