"""attnwarp edit --preview and --answer on a small random editor; the oracle is the edit by the answer's seed."""

import json
import shutil
from base64 import b64decode

import cv2
import numpy as np
import pytest
from loaded_once import editors_are_loaded_once, short_orbit  # noqa: F401
from skimage.color import deltaE_ciede2000, rgb2lab
from tiny_editors import pix2pix
from tiny_joint import klein_folder
from tiny_scenes import cameras, pictures, splats
from typer.testing import CliRunner

from attnwarp.cli.main import app
from attnwarp.command import preview
from attnwarp.editing.small import load_editor
from attnwarp.io import Dataset, read_image, read_ply, write_ply, write_transforms
from attnwarp.io.images import encode_png
from attnwarp.methods import attention_warping, preset
from attnwarp.methods.algorithms.attention_warping import AttentionWarping
from attnwarp.reporting import Reporter

LEFT = np.arange(32) < np.full((32, 1), 16)
QUICK = ("--steps", 2, "--iterations", 1, "--stages", 1, "--size", 32, "--threads", 1)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A capture of three views, its splats, masks of their left halves, and an editor."""
    folder = tmp_path_factory.mktemp("preview")
    model, views = splats(30), cameras(3)
    for name in ("data/images", "masks"):
        (folder / name).mkdir(parents=True)
    paths = [folder / "data" / "images" / camera.name for camera in views]
    for path, image in zip(paths, pictures(model, views), strict=True):
        path.write_bytes(encode_png(np.rint(255 * image).astype(np.uint8)))
        half = np.repeat(255 * LEFT[..., None], 3, axis=2).astype(np.uint8)
        (folder / "masks" / path.name).write_bytes(encode_png(half))
    write_transforms(folder / "data", Dataset(views, paths))
    write_ply(folder / "splats.ply", model)
    pix2pix(halvings=2).save_pretrained(folder / "editor")
    return folder


def run(place, out, *more, words="a bear"):
    given = (
        "edit", place / "data", "--instruction", words, "--editor", place / "editor", "--out", out,
        "--ply", place / "splats.ply", "--masks", place / "masks", *QUICK, *more,
    )  # fmt: skip
    return CliRunner().invoke(app, [str(word) for word in given])


@pytest.fixture(scope="module")
def shown(place):
    """The folder and the result of a preview."""
    return place / "shown", run(place, place / "shown", "--preview")


@pytest.fixture
def own(shown, tmp_path):
    """A copy of the preview's folder."""
    return shutil.copytree(shown[0], tmp_path / "own")


@pytest.fixture(scope="module")
def by_seed(place):
    """The folder of the edit by seed 2."""
    assert run(place, place / "by-seed", "--seed", 2, "--no-control").exit_code == 0
    return place / "by-seed"


@pytest.mark.parametrize("name", ["small-depth", pytest.param("klein", marks=pytest.mark.door)])
def test_editors_of_depth_and_of_joint_attention_go_on_from_an_answer_too(name, place, tmp_path):
    if name == "klein":
        klein_folder(tmp_path / name)
        name = tmp_path / name
    given = ("--editor", name, "--no-control", "--anyway")
    for out, more in (("own", "--preview"), ("own", "--answer=1"), ("plain", "--seed=1")):
        result = run(place, tmp_path / out, *given, more)
        assert result.exit_code == 0, result.output
    assert same_edit(tmp_path / "own", tmp_path / "plain")


def same_edit(one, two):
    names = ["edited.ply", *(f"views/v{k}.png" for k in range(3))]
    return all((one / name).read_bytes() == (two / name).read_bytes() for name in names)


@pytest.mark.parametrize("kept", [True, False])
def test_an_edit_from_an_answer_is_the_edit_by_its_seed(kept, place, own, by_seed, monkeypatch):
    """The source is denoised again only where its features are gone."""
    denoised, denoise = [], AttentionWarping.denoise
    monkeypatch.setattr(
        AttentionWarping, "denoise",
        lambda self, start, *rest: denoised.extend(start.views) or denoise(self, start, *rest),
    )  # fmt: skip
    if not kept:
        (own / "preview" / "2.pt").unlink()
    result = run(place, own, "--answer", 2, "--no-control")
    assert result.exit_code == 0, result.output
    assert same_edit(own, by_seed)
    assert sorted(denoised) == ([1, 2] if kept else [0, 1, 2])
    assert not list((own / "preview").glob("*.pt"))
    again = run(place, own, "--answer", 2, "--no-control")  # a finished one
    assert again.exit_code == 0 and same_edit(own, by_seed)


def test_the_page_shows_the_mark_and_how_much_each_answer_changed(place, shown):
    """Oracles: the editor's pictures of the library by seed, scikit-image's CIEDE2000."""
    out, result = shown
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines()[-1] == str(out / "preview" / "index.html")
    page = (out / "preview" / "index.html").read_text()
    found = [
        part.split(";base64,")[1].split('"')[0]
        for part in page.split("<img ")
        if ";base64," in part
    ]
    drawn = [cv2.imdecode(np.frombuffer(b64decode(text), np.uint8), cv2.IMREAD_COLOR_RGB)
             for text in found]  # fmt: skip
    before = read_image(place / "data" / "images" / "v0.png")
    assert len(drawn) == 6 and np.array_equal(drawn[0], before)
    assert np.abs(drawn[1] - before * np.where(LEFT, 1, 0.2)[..., None]).max() <= 0.5
    for seed, pixels in enumerate(drawn[2:]):
        change = deltaE_ciede2000(rgb2lab(before[LEFT]), rgb2lab(pixels[LEFT]))
        share, size = (change >= 3).mean(), change.mean()
        line = f"answer {seed}: {share:.0%} of the mask changed, by {size:.1f} dE00 in the mean"
        assert line in result.stdout and line in page
    assert len({pixels.tobytes() for pixels in drawn[2:]}) == 4
    settings = preset("attention_warping", "extended", steps=2, iterations=0, size=32, seed=3)
    answer = attention_warping(
        read_ply(place / "splats.ply"), cameras(3),
        [read_image(path) for path in sorted((place / "data" / "images").iterdir())],
        load_editor(str(place / "editor")), "a bear", settings, segments=[LEFT] * 3,
    )  # fmt: skip
    assert np.array_equal(answer.edited[0], drawn[5])


def test_a_preview_goes_on_where_it_was_stopped_and_other_words_make_it_anew(
    place, own, monkeypatch
):
    kept = (own / "preview" / "0.png").stat().st_mtime_ns
    for name in ("3.png", "3.json"):
        (own / "preview" / name).unlink()
    assert run(place, own, "--preview").exit_code == 0
    assert (own / "preview" / "3.png").is_file()
    assert (own / "preview" / "0.png").stat().st_mtime_ns == kept
    other = run(place, own, "--preview", words="a cat")
    assert other.exit_code == 0 and 'of other instruction ("a bear", now "a cat")' in other.stderr
    assert (own / "preview" / "0.png").stat().st_mtime_ns != kept
    assert "<h1>a cat</h1>" in (own / "preview" / "index.html").read_text()


@pytest.mark.parametrize(("more", "said"), [
    (("--preview", "--answer", 1), "--answer: got --preview too"),
    (("--preview", "--source-picture", "x.png"), "--preview: got --source-picture too"),
    (("--preview", "--method", "by_view"), "--preview: is of attention_warping, not of by_view"),
    (("--answer", 4), "--answer: got 4, expected one of the preview's: 0, 1, 2, 3"),
    (("--answer", 1, "--set", "a0=0.5"), "of other settings.a0 ("),
    (("--answer", 1, "--source", "v1.png"), "of other options.source ("),
])  # fmt: skip
def test_what_a_preview_cannot_give_is_one_clear_line(more, said, place, own):
    result = run(place, own, *more)
    assert result.exit_code == 2 and said in result.stderr
    assert not (own / "manifest.json").exists()


def test_an_answer_without_a_preview_or_of_damaged_files_is_refused(place, own, tmp_path):
    result = run(place, tmp_path / "none", "--answer", 1)
    assert result.exit_code == 2 and "has no such answer; run the same command" in result.stderr
    features = own / "preview" / "1.pt"
    features.write_bytes(features.read_bytes()[:-100])
    result = run(place, own, "--answer", 1)
    assert result.exit_code == 2 and "1.pt: its checksum does not match" in result.stderr
    assert not (own / "manifest.json").exists()
    (own / "preview" / "manifest.json").write_text("{")
    for more in (("--answer", 2), ("--preview",)):
        result = run(place, own, *more)
        assert result.exit_code == 2 and "manifest.json: " in result.stderr
    (own / "preview" / "manifest.json").unlink()
    result = run(place, own, "--preview")
    assert result.exit_code == 2 and "has no manifest.json" in result.stderr


def test_a_source_that_comes_out_otherwise_than_its_answer_is_refused(place, own):
    """The features are gone, and the picture that was shown is that of another seed."""
    for suffix in ("png", "json"):
        shutil.copy(own / "preview" / f"3.{suffix}", own / "preview" / f"1.{suffix}")
    (own / "preview" / "1.pt").unlink()
    result = run(place, own, "--answer", 1)
    assert result.exit_code == 2 and "not the one that 1.png was" in result.stderr


def test_features_beyond_the_limit_are_not_kept(place, tmp_path, monkeypatch):
    monkeypatch.setattr(preview, "MOST_KEPT", 0)
    assert run(place, tmp_path, "--preview").exit_code == 0
    assert sorted(path.name for path in (tmp_path / "preview").glob("[0-9]*")) == sorted(
        f"{seed}.{suffix}" for seed in range(4) for suffix in ("json", "png")
    )


def test_an_edit_that_was_stopped_leaves_a_page_of_its_views(place, tmp_path, monkeypatch):
    told, edit = [], AttentionWarping.edit_targets

    def stopped(self, stage, batch, *rest):
        if told:
            raise KeyboardInterrupt
        told.append(batch[0])
        return edit(self, stage, batch, *rest)

    monkeypatch.setattr(AttentionWarping, "edit_targets", stopped)
    result = run(place, tmp_path, "--no-control", "--set", "batch=1")
    assert result.exit_code == 130
    page = (tmp_path / "index.html").read_text()
    assert "2 views are edited so far, 3 edits are planned" in page
    for view in (0, told[0]):
        picture = (tmp_path / "rounds" / "1" / f"v{view}.png").read_bytes()
        pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
        text = page.split(f'alt="v{view}, edited" src="data:image/png;base64,')[1].split('"')[0]
        shown = cv2.imdecode(np.frombuffer(b64decode(text), np.uint8), cv2.IMREAD_COLOR)
        assert np.array_equal(shown, pixels)
    assert run(place, tmp_path, "--preview").exit_code == 2  # the folder holds an edit
    assert json.loads((tmp_path / "manifest.json").read_text())["settings"]["seed"] == 0


def test_progress_tells_the_views_that_are_left(place):
    class Told(Reporter):
        texts: list[str] = []  # noqa: RUF012

        def step(self, done, total, text, left=None):
            self.texts.append(text)

    views, model = cameras(3), splats(30)
    settings = preset("attention_warping", "corrected", stages=1, steps=1, iterations=1)
    attention_warping(
        model, views, None, load_editor(str(place / "editor")), "red", settings, report=Told()
    )
    ends = [text.partition("; ")[2] for text in Told.texts]
    # A batch of two, the begin of the tuning, its iteration, the end.
    assert ends == ["3 views to edit", "2 views to edit", "", "", ""]
