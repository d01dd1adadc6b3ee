"""attnwarp edit by a method that attention warping is compared with, on a small random editor in a folder; the oracle is the library."""

import numpy as np
import pytest
from tiny_editors import pix2pix
from tiny_scenes import cameras, pictures, splats
from typer.testing import CliRunner

from attnwarp.cli.main import app
from attnwarp.editing.small import load_editor
from attnwarp.fit import load_views
from attnwarp.io import Dataset, read_dataset, read_image, read_ply, write_ply, write_transforms
from attnwarp.io.images import encode_png
from attnwarp.methods import ByViewSettings, by_view


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A data set, its splats, and an editor."""
    folder = tmp_path_factory.mktemp("baseline")
    model, views = splats(30), cameras(2)
    (folder / "data" / "images").mkdir(parents=True)
    paths = []
    for camera, image in zip(views, pictures(model, views), strict=True):
        paths.append(folder / "data" / "images" / camera.name)
        paths[-1].write_bytes(encode_png(np.rint(255 * image).astype(np.uint8)))
    write_transforms(folder / "data", Dataset(views, paths))
    write_ply(folder / "splats.ply", model)
    pix2pix().save_pretrained(folder / "editor")
    return folder


def run(place, *words):
    given = [
        "--ply", place / "splats.ply", "--editor", place / "editor", "--instruction", "a bear",
        "--out", place / "out", "--threads", 1, "--size", 32,
    ]  # fmt: skip
    arguments = ["edit", place / "data", *given, "--method", *words]
    return CliRunner().invoke(app, [str(word) for word in arguments])


def test_the_command_gives_what_the_library_gives_and_says_where(place):
    result = run(place, "by_view", "--steps", 1, "--iterations", 1)
    assert result.exit_code == 0, result.stderr
    out = place / "out"
    assert str(out / "edited.ply") in result.stdout
    assert "2 edited views in" in result.stdout
    assert result.stdout.splitlines()[-1] == str(out / "index.html")
    views = load_views(read_dataset(place / "data"))
    images = [read_image(place / "data" / camera.name) for camera in views.cameras]
    expected = by_view(
        read_ply(place / "splats.ply"),
        views.cameras,
        images,
        load_editor(str(place / "editor")),
        "a bear",
        ByViewSettings(size=32, steps=1, iterations=1),
    )
    for view, pixels in expected.edited.items():
        assert np.array_equal(read_image(out / "views" / f"v{view}.png"), pixels)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("dge", "--preset", "relesed"), "preset: got 'relesed'"),
        (("dge", "--steps", 9, "--set", "starts=[998, 3]"), "starts: 3 leaves too few"),
        (("dge", "--store", "disk"), "--store: is of attention_warping, not of dge; leave it out"),
        (("igs2gs",), 'holds an edit of other method ("by_view", now "igs2gs")'),
    ],
)
def test_mistakes_end_in_one_line_and_exit_code_2(place, words, message):
    if "holds" in message:
        assert run(place, "by_view", "--steps", 1, "--iterations", 1).exit_code == 0
    else:
        words = (*words, "--out", place / "another")
    result = run(place, *words)
    assert result.exit_code == 2
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("attnwarp: ")]
    assert message in line
