"""The whole command on two exported scenes, killed half-way and begun again."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import yaml
from edit_folders import files
from PIL import Image
from reproduction import EDIT, SIZE, VIEWS, write
from skimage.metrics import peak_signal_noise_ratio
from typer.testing import CliRunner

from attnwarp.editing.small import load_editor
from attnwarp.encoders import pretrained
from attnwarp.io import read_ply
from attnwarp_eval.cli.main import app
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.reproduce.cells import settings_of
from attnwarp_eval.reproduce.manifest import load_manifest
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.splats.export import orbit
from attnwarp_eval.study.editing_methods import EDITING_METHODS, Job
from attnwarp_eval.truth import appearance

pytestmark = pytest.mark.slow


def command(folder, out, *more):
    arguments = ["reproduce", str(folder / "manifest.yaml"), "--out", str(out), *more]
    return [sys.executable, "-m", "attnwarp_eval", *arguments]


def whole(folder, out, *more):
    done = subprocess.run(command(folder, out, *more), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return done


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write(tmp_path_factory.mktemp("reproduction"))


@pytest.fixture(scope="module")
def run(folder):
    whole(folder, folder / "run", "--jobs", "2")
    return folder / "run"


def records(run):
    """Cells without what was measured in seconds and bytes."""
    cells = [json.loads(p.read_bytes()) for p in sorted((run / "cells").rglob("*.json"))]
    return [{k: v for k, v in cell.items() if k not in ("cost", "sha256")} for cell in cells]


def test_a_run_that_was_killed_half_way_gives_the_same_bytes(folder, run):
    """Oracle: the run of two processes that nothing disturbed."""
    killed = folder / "killed"
    for cells in (2, 8):
        process = subprocess.Popen(
            command(folder, killed), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        while len(list((killed / "cells").rglob("*.json"))) < cells:
            assert process.poll() is None
            time.sleep(0.2)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        assert not (killed / "results.json").exists()
    whole(folder, killed)
    assert (killed / "results.json").read_bytes() == (run / "results.json").read_bytes()
    assert records(killed) == records(run)
    assert files(killed / "made") == files(run / "made")
    assert (killed / "userstudy.html").read_bytes() == (run / "userstudy.html").read_bytes()


def test_the_tables_have_the_written_pictures_figures_beside_the_papers(run):
    """Oracle: skimage's PSNR of the written pictures; the manifest's published numbers."""
    results = json.loads((run / "results.json").read_text())
    edits = [cell for cell in results["cells"] if cell["kind"] == "edit"]
    assert len(edits) == 2 * (3 + 2)  # two scenes; a method with two seeds among four
    for cell in edits:
        place = run / "made" / cell["id"][:16]
        edited = {p.name: np.asarray(Image.open(p)) for p in (place / "edited").iterdir()}
        assert len(edited) == cell["counts"]["edited"] and cell["counts"]["views"] == VIEWS
        values = [
            peak_signal_noise_ratio(pixels, np.asarray(Image.open(place / "renders" / name)))
            for name, pixels in edited.items()
        ]
        psnr = cell["figures"]["Edit PSNR, mean of the views"]
        assert psnr == pytest.approx(np.mean(values), abs=1e-3)
        assert cell["authors"]["CLIP similarity"] == pytest.approx(
            cell["figures"]["CLIP similarity"], abs=1e-6
        )  # pictures have the encoder's size
        if "DINO single-image similarity" in cell["figures"]:
            title = "DINO single-image similarity"
            assert cell["authors"][title] != pytest.approx(cell["figures"][title], abs=1e-6)
    text = (run / "reproduction.md").read_text()
    for part in ("22.780", "not at hand", "IGS2GS below attention warp", "## 2DGS against 3DGS",
                 "## Variability over seeds", "## Cost by method", "can't tell"):  # fmt: skip
        assert part in text
    assert "data:image/jpeg" in (run / "userstudy.html").read_text()


def test_an_exported_scene_gives_the_studys_edited_pictures(folder, run):
    """Oracle: the study's way to edit true pictures, which never were files, by the same splats and seed."""
    loaded = load_manifest(str(folder / "manifest.yaml"))
    row = loaded.manifest.methods["attention warp"]
    scene = load_scene("spheres")
    cameras = orbit(scene, VIEWS, SIZE)
    images = [np.asarray(to_srgb(appearance(scene, c, spp=2)), np.float32) for c in cameras]
    splats = read_ply(run / "fits" / "spheres-2d" / "splats.ply")
    editor = load_editor(loaded.editor("pix2pix"))
    settings = settings_of(loaded, row, 0, EDIT["source"])
    job = Job(splats, cameras, images, editor, EDIT["instruction"], settings, folder / "study",
              None, {})  # fmt: skip
    study = EDITING_METHODS["attention_warping"].run(job)
    results = json.loads((run / "results.json").read_text())
    (cell,) = (
        c
        for c in results["cells"]
        if (c["scene"], c["methods"], c["seed"]) == ("spheres", ["attention warp"], 0)
    )
    assert set(study.edited) == {
        int(p.stem[-4:]) for p in (run / "made" / cell["id"][:16] / "edited").iterdir()
    }
    for view, pixels in study.edited.items():
        path = run / "made" / cell["id"][:16] / "edited" / f"view-{view:04d}.png"
        assert np.abs(np.asarray(Image.open(path)).astype(int) - pixels).max() <= 1


def test_a_sealed_run_is_verified_and_held_beside_another(folder, run):
    """Oracle: hashlib's SHA-256 of a file, and a byte that is changed."""

    def call(*arguments):
        return CliRunner().invoke(app, [*map(str, arguments)])

    seal = json.loads((run / "seal.json").read_text())
    (picture, *_) = (name for name in seal["files"] if "/renders/" in name)
    data = (run / picture).read_bytes()
    assert seal["files"][picture] == hashlib.sha256(data).hexdigest()
    done = call("verify", run)
    assert done.exit_code == 0 and "every hash fits" in done.stdout
    other = folder / "other"
    shutil.copytree(run, other)
    both = call("compare", run, other)
    assert both.exit_code == 0 and "same inputs, code and versions" in both.stdout
    for name in ("made/" + picture.split("/", 1)[1], "results.json", "seal.json"):
        path = other / name
        whole_file = path.read_bytes()
        path.write_bytes(whole_file[:-3] + bytes([whole_file[-3] ^ 1]) + whole_file[-2:])
        bad = call("verify", other)
        assert bad.exit_code == 3 and name.split("/")[-1] in bad.stdout
        assert call("compare", run, other).exit_code == 2
        path.write_bytes(whole_file)


def test_quick_runs_two_methods_on_one_scene(folder, monkeypatch):
    """Oracle: the files' sizes; and that of two cells, each with four figures' encoders, the second
    loads none."""
    out = folder / "quick"
    lines = whole(folder, out, "--quick", "--dry-run").stdout.splitlines()
    assert lines[-1].startswith("to do: 3 cells, ") and "GB of disk" in lines[-1]
    assert not (out / "cells").exists()
    loaded = []

    def spy(kind, place, *rest):
        loaded.append(place.name)
        return load(kind, place, *rest)

    load = pretrained._load
    monkeypatch.setattr(pretrained, "_load", spy)
    done = CliRunner().invoke(app, command(folder, out, "--quick")[3:])
    assert done.exit_code == 0, done.output
    # Once in the check, then with both preprocessings.
    assert sorted(loaded) == 3 * ["clip"] + 3 * ["dino"]
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    told = float(lines[-1].split(", ")[-1].removesuffix(" GB of disk"))
    assert told == pytest.approx(size / 1e9, rel=0.25)
    results = json.loads((out / "results.json").read_text())
    assert [(c["scene"], c["methods"]) for c in results["cells"] if c["kind"] == "edit"] == [
        ("spheres", ["attention warp"]),
        ("spheres", ["IGS2GS"]),
    ]
    for name in ("attention warp", "IGS2GS"):
        (cell,) = (c for c in results["cells"] if c["methods"] == [name])
        told = f"{name}: 1 cells, {cell['counts']['network_rows']} network rows, "
        assert any(line.startswith(told) for line in lines)
    assert yaml.safe_load((folder / "manifest.yaml").read_text())["seeds"] == [0]
