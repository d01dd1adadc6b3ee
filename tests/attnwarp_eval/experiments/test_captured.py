"""A study on a person's capture. Oracles: the files that were written, and another library's PSNR."""

import json

import numpy as np
import pytest
import yaml
from few_splats import few_splats
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio
from tiny_editors import controlnet, pix2pix
from typer.testing import CliRunner

from attnwarp import Camera
from attnwarp.editing.small import load_editor
from attnwarp.io import Dataset, write_ply, write_transforms
from attnwarp.methods.scene import editor_digest
from attnwarp.render import render
from attnwarp_eval.cli.main import app

pytestmark = pytest.mark.slow

STUDY = {
    "name": "mine",
    "scenes": ["bear"],
    "encoders": {"clip": "clip-small", "dino": "dino-small"},
    "editing": {"editor": {"name": "small-plain"}, "options": {"size": 32}},
    "variants": {
        "whole": {"method": "by_view", "options": {"steps": 1, "iterations": 2}},
        "short": {"method": "by_view", "options": {"steps": 1, "iterations": 2, "batch": 1},
                  "budget": {"network_rows": 5}},
        "timed": {"method": "by_view", "options": {"steps": 1, "iterations": 2},
                  "budget": {"seconds_of": "whole"}},
        "ceiling": {"method": "true pictures"},
        "oracle": {"mask": "truth"},
        "inverted": {"method": "gaussctrl", "editor": {"name": "small-depth"},
                     "options": {"steps": 1, "iterations": 0, "source_prompt": "{source}, far"}},
    },
    "probes": {"editing": ["whole", "short", "timed", "ceiling", "oracle", "inverted"]},
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A capture of three views of 32 px, in two scales, its splats, and a study."""
    path = tmp_path_factory.mktemp("capture")
    splats = few_splats()
    write_ply(path / "scene.ply", splats)
    cameras, paths = [], []
    for k, angle in enumerate((-0.4, 0.0, 0.4)):
        camera = Camera.look_at(
            [3 * np.sin(angle), -3 * np.cos(angle), 0.5], [0, 0, 0], width=32, height=32, fov_y=40
        )
        pixels = np.round(255 * render(splats, camera).color.clamp(0, 1).numpy()).astype(np.uint8)
        for name, side in (("images", 32), ("images_2", 16)):
            (path / name).mkdir(exist_ok=True)
            Image.fromarray(pixels).resize((side, side), Image.Resampling.BOX).save(
                path / name / f"{k}.png"
            )
        cameras.append(camera)
        paths.append(path / "images" / f"{k}.png")
    write_transforms(path / "transforms.json", Dataset(cameras, paths))
    (path / "study.yaml").write_text(yaml.safe_dump(STUDY))
    return path


def run(folder, out, *more):
    return CliRunner().invoke(app, [
        "run", str(folder / "study.yaml"), "--data", str(folder), "--out", str(out), *map(str, more),
    ])  # fmt: skip


WORDS = (
    "--instruction",
    "make it red",
    "--target-prompt",
    "a red thing",
    "--source-prompt",
    "a thing",
)


def read(path):
    return np.asarray(Image.open(path))


@pytest.fixture(scope="module")
def done(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    result = run(folder, out, "--ply", folder / "scene.ply", *WORDS)
    assert result.exit_code == 0, result.output
    return result, out, json.loads((out / "captured.json").read_text())


def test_the_figures_are_those_of_the_written_pictures(done, folder):
    _, out, data = done
    assert list(data["variants"]) == ["whole", "short", "inverted", "timed"]
    manifest = out / data["variants"]["inverted"]["folder"] / "run" / "manifest.json"
    assert json.loads(manifest.read_text())["settings"]["source_prompt"] == "a thing, far"
    row = data["variants"]["whole"]
    renders, edited = (
        {p.stem: read(p) for p in (out / row["folder"] / name).iterdir()}
        for name in ("renders", "edited")
    )
    assert sorted(renders) == sorted(edited) == [f"view-{k:04d}" for k in range(3)]
    expected = np.mean(
        [peak_signal_noise_ratio(edited[k], renders[k], data_range=255) for k in renders]
    )
    assert row["figures"]["Edit PSNR, mean of the views"] == pytest.approx(expected, abs=1e-3)
    assert set(row["figures"]) >= {
        "CLIP similarity",
        "CLIP directional similarity",
        "DINO single-image similarity",
    }
    # Three views, one step, two rows each; image guidance of 1 drops a branch.
    assert (row["network_rows"], row["edited_views"], row["cut"]) == (6, 3, None)
    for k in range(3):
        assert (
            read(out / "originals" / f"view-{k:04d}.png") == read(folder / "images" / f"{k}.png")
        ).all()


def test_what_did_not_finish_and_what_needs_truth_stand_there_by_name(done):
    result, out, data = done
    assert (data["variants"]["short"]["cut"], data["variants"]["short"]["edited_views"]) == (
        "network_rows",
        2,
    )
    left = data["left_out"]
    assert left["variant ceiling"] == "its edits are the true pictures"
    assert left["variant oracle"] == "its warp is the true one"
    assert {"same answer", "PSNR to truth inside, dB", "AbsRel of depth after"} <= set(left)
    assert not {"Edit PSNR, dB", "CLIP direction"} & set(left)
    assert "left out: variant ceiling" in result.stderr
    report = (out / "captured.md").read_text()
    # The machine decides whether "timed" is there too.
    assert "**Did not finish within their budget: short" in report
    assert "| same answer | multiview.same_answer.edit needs" in report
    assert (out / "captured.html").read_text().count("data:image/png") >= 3


def test_a_second_run_edits_nothing_again_and_gives_the_same_figures(done, folder):
    _, out, data = done
    before = (out / "variant-1" / "run" / "rounds" / "1.pt").stat().st_mtime_ns
    assert run(folder, out, "--ply", folder / "scene.ply", *WORDS).exit_code == 0
    again = json.loads((out / "captured.json").read_text())
    assert (out / "variant-1" / "run" / "rounds" / "1.pt").stat().st_mtime_ns == before
    assert again["variants"]["whole"]["figures"] == data["variants"]["whole"]["figures"]
    # Another limit would be refused as that of another edit.
    assert again["variants"]["timed"]["figures"] == data["variants"]["timed"]["figures"]


def test_smaller_copies_of_the_pictures_are_read_by_their_scale(folder, tmp_path):
    done = run(
        folder,
        tmp_path,
        "--ply",
        folder / "scene.ply",
        "--instruction",
        "make it red",
        "--scale",
        2,
    )
    assert done.exit_code == 0, done.output
    assert read(tmp_path / "originals" / "view-0000.png").shape == (16, 16, 3)
    left = json.loads((tmp_path / "captured.json").read_text())["left_out"]
    assert left["CLIP similarity"] == "needs --prompt"
    assert left["variant inverted"] == "it inverts with the words of --source-prompt"


@pytest.mark.filterwarnings("always::attnwarp.errors.InputWarning")
def test_different_numbers_of_edited_views_are_told_before_and_in_the_report(folder, tmp_path):
    """Oracle: the pictures that each method left."""
    quick = {"steps": 1, "iterations": 1}
    own = {
        "variants": {
            "every": {"method": "by_view", "options": quick},
            "drawn": {"method": "dge", "options": {**quick, "every": 1, "views": 2}},
            "staged": {"options": {**quick, "stages": 1, "views_per_stage": 1}},
        },
        "probes": {"editing": ["every", "drawn", "staged"]},
    }
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(STUDY | own))
    out = tmp_path / "out"
    done = CliRunner().invoke(app, [
        "run", str(tmp_path / "study.yaml"), "--data", str(folder), "--ply", str(folder / "scene.ply"),
        "--out", str(out), "--instruction", "make it red",
    ])  # fmt: skip
    assert done.exit_code == 0, done.output
    rows = json.loads((out / "captured.json").read_text())["variants"]
    counts = [len(list((out / row["folder"] / "edited").iterdir())) for row in rows.values()]
    assert counts == [3, 2, 2]
    assert "of 3 views, variants edit every 3, drawn 2, staged 2; Edit PSNR" in done.stderr
    told = "Variants edited different numbers of views: every 3, drawn 2, staged 2."
    assert told in (out / "captured.md").read_text()


def test_editors_of_ones_own_stand_for_the_studys_by_what_they_take(folder, tmp_path, monkeypatch):
    """Oracle: the digest of the weights in each folder, beside what each method wrote of its editor."""
    pix2pix().save_pretrained(tmp_path / "picture")
    controlnet().save_pretrained(tmp_path / "base")
    (tmp_path / "base" / "controlnet").rename(tmp_path / "depth")
    both = f"{tmp_path / 'base'},{tmp_path / 'depth'}"
    asked = []

    def spy(name, **given):
        asked.append((name, given.pop("device")))
        return load_editor(name, **given)

    monkeypatch.setattr("attnwarp.editing.small.load_editor", spy)
    options = {"stages": 1, "steps": 1, "iterations": 1}
    own = {
        "variants": {
            "plain": {"options": options},
            "depth": {"editor": {"name": "small-depth"}, "options": options},
        },
        "probes": {"editing": ["plain", "depth"]},
    }
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(STUDY | own))
    arguments = [
        "run", tmp_path / "study.yaml", "--data", folder, "--ply", folder / "scene.ply", "--out", tmp_path / "out",
        "--instruction", "a bear", "--editor", tmp_path / "picture", "--depth-editor", both, "--device", "cpu:0",
    ]  # fmt: skip
    done = CliRunner().invoke(app, [*map(str, arguments)])
    assert done.exit_code == 0, done.output
    rows = json.loads((tmp_path / "out" / "captured.json").read_text())["variants"]
    expected = {"plain": str(tmp_path / "picture"), "depth": both}
    assert {name: row["editor"] for name, row in rows.items()} == expected
    for name, row in rows.items():
        manifest = json.loads(
            (tmp_path / "out" / row["folder"] / "run" / "manifest.json").read_text()
        )
        assert manifest["inputs"]["editor"] == editor_digest(load_editor(expected[name]))
    assert asked == [(name, "cpu:0") for name in expected.values()]


def test_options_of_captures_and_of_scenes_are_not_passed_over(folder):
    of_captures = ["editor", "depth-editor", "device", "ply", "instruction", "target-prompt",
                   "source-prompt"]  # fmt: skip
    start = ["run", str(folder / "study.yaml")]
    for option, *value in (*((f"--{name}", "cuda") for name in of_captures), ("--scale", "2")):
        done = CliRunner().invoke(app, [*start, "--dry-run", option, *value])
        assert done.exit_code == 2 and f"{option}: needs --data" in done.stderr
    for option, *value in (("--dry-run",), ("--scenes", "bear"), ("--jobs", "2"),
                           ("--scheduler", "tcp://a:1"), ("--fail-fast",)):  # fmt: skip
        done = CliRunner().invoke(app, [*start, "--data", str(folder), option, *value])
        assert done.exit_code == 2 and f"{option}: has no meaning with --data" in done.stderr


GIVEN = ("--ply", "scene.ply", "--instruction", "red")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--instruction", "red"], "needs --ply"),
        (["--ply", "scene.ply"], "needs --instruction"),
        (["--ply", "scene.ply", "--instruction", "red", "--scale", "3"], "scale (--scale): got 3"),
        (["--ply", "none.ply", "--instruction", "red"], "none.ply"),
        ([*GIVEN, "--device", "gpu"], "device 'gpu': unknown, expected cpu or cuda"),
        ([*GIVEN, "--editor", "smal"], "editor 'smal': neither bundled"),
        ([*GIVEN, "--editor", "small-depth"], "takes depth maps, expected an editor that takes a"),
        ([*GIVEN, "--depth-editor", "small-depth"], "no variant of mine has an editor that takes"),
    ],
)
def test_what_is_missing_is_one_line(folder, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(folder)
    done = run(folder, tmp_path, *arguments)
    assert done.exit_code == 2 and message in done.stderr and done.stderr.count("\n") == 1
