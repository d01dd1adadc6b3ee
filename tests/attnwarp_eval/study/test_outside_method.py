"""Results of another program in a study. Oracle: the program of the test, on the bytes that it was given."""

import numpy as np
import pytest
from tiny_scenes import cameras, pictures, splats

from attnwarp.errors import InputError
from attnwarp.io import read_dataset, read_image, read_ply, write_ply
from attnwarp_eval.files import write_picture
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS, Job


def test_a_scene_goes_to_a_folder_and_its_result_comes_from_there(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "attnwarp_eval.study.shared.editing_methods.EDITING_METHODS", dict(EDITING_METHODS)
    )
    import outside_method

    model, views = splats(), cameras(3)
    images = pictures(model, views)
    settings = outside_method.settings("paper", {"root": str(tmp_path), "steps": 8}, 2)
    job = Job(model, views, images, None, "make it red", settings, tmp_path, None, {})
    with pytest.raises(InputError, match=r"has no edited.ply; run the method on it"):
        outside_method.run(job)

    (place,) = tmp_path.iterdir()
    given = read_dataset(place)
    assert (place / "instruction.txt").read_text() == "make it red"
    assert read_ply(place / "splats.ply").digest() == model.digest()
    for camera, own, path, image in zip(
        given.cameras, views, given.image_paths, images, strict=True
    ):
        assert np.allclose(camera.world_to_camera, own.world_to_camera, rtol=0, atol=1e-12)
        assert np.array_equal(camera.K, own.K)
        assert np.abs(read_image(path) / 255 - image).max() <= 0.5 / 255 + 1e-6

    # The other program: it edits the source and the last view, and moves the splats.
    for name in ("000", "002"):
        before = read_image(place / "images" / f"{name}.png")
        write_picture(place / "edited" / f"{name}.png", 255 - before)
    moved = read_ply(place / "splats.ply").detach()
    moved.means += 1
    write_ply(place / "edited.ply", moved)
    (place / "seconds.txt").write_text("12.5")

    result = outside_method.run(job)
    assert list(result.edited) == [0, 2]
    for k, picture in result.edited.items():
        assert np.abs((255 - picture) / 255 - images[k]).max() <= 0.5 / 255 + 1e-6
    assert result.gaussians.digest() == moved.digest()
    assert result.seconds == {"edit": 12.5}
    # Another seed and another instruction have folders of their own.
    for change in ({"instruction": "make it blue"}, {"settings": {**settings, "seed": 3}}):
        with pytest.raises(InputError, match="has no edited.ply"):
            outside_method.run(Job(**{**vars(job), **change}))
    assert len(list(tmp_path.iterdir())) == 3
