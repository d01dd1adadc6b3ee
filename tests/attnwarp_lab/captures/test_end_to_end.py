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
from distributed import LocalCluster
from edit_folders import files
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio
from small_manifest import EDIT, MANIFEST, SIZE, VIEWS, save, write
from tiny_models import linear_layers, save_backbone
from typer.testing import CliRunner

from attnwarp.editing.small import load_editor
from attnwarp.encoders import lpips, pretrained
from attnwarp.io import read_ply
from attnwarp_eval.cli.main import app
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.splats.export import orbit
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS, Job
from attnwarp_eval.truth import appearance
from attnwarp_lab.captures.cells import settings_of
from attnwarp_lab.captures.manifest import load_manifest

pytestmark = pytest.mark.slow


def command(folder, out, *more, manifest="manifest.yaml"):
    arguments = ["captures", str(folder / manifest), "--out", str(out), *more]
    return [sys.executable, "-m", "attnwarp_eval", *arguments]


def whole(*arguments, **more):
    done = subprocess.run(command(*arguments, **more), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return done


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write(tmp_path_factory.mktemp("captures"))


@pytest.fixture(scope="module")
def run(folder):
    whole(folder, folder / "run", "--device", "cpu,cpu")
    return folder / "run"


def records(run):
    """Cells without what was measured in seconds and bytes."""
    cells = [json.loads(p.read_bytes()) for p in sorted((run / "cells").rglob("*.json"))]
    return [{k: v for k, v in cell.items() if k not in ("cost", "sha256")} for cell in cells]


def made(run):
    """Files of all cells but for the pages, which tell seconds."""
    return {k: v for k, v in files(run / "made").items() if not k.endswith("index.html")}


def test_a_run_that_was_killed_half_way_gives_the_same_bytes(folder, run):
    """Oracle: the run that nothing disturbed, of two devices, each with a process of its own."""
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
    assert made(killed) == made(run)
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
    text = (run / "report.md").read_text()
    for part in ("22.780", "not at hand", "IGS2GS below attention warp", "## 2DGS against 3DGS",
                 "## Variability over seeds", "## Cost by variant", "can't tell"):  # fmt: skip
        assert part in text
    assert "data:image/jpeg" in (run / "userstudy.html").read_text()


def test_an_exported_scene_gives_the_studys_edited_pictures(folder, run):
    """Oracle: the study's way to edit true pictures, which never were files, by the same splats and seed."""
    loaded = load_manifest(str(folder / "manifest.yaml"))
    row = loaded.manifest.variants["attention warp"]
    scene = load_scene("spheres")
    cameras = orbit(scene, VIEWS, SIZE)
    images = [np.asarray(to_srgb(appearance(scene, c, spp=2)), np.float32) for c in cameras]
    splats = read_ply(run / "fits" / "spheres-2d" / "splats.ply")
    editor = load_editor(loaded.editor("pix2pix"))
    settings = settings_of(loaded, row, 0, SIZE)
    job = Job(splats, cameras, images, editor, EDIT["instruction"], settings, folder / "study",
              None, {})  # fmt: skip
    study = EDITING_METHODS["attention_warping"].run(job)
    results = json.loads((run / "results.json").read_text())
    (cell,) = (
        c
        for c in results["cells"]
        if (c["scene"], c["variants"], c["seed"]) == ("spheres", ["attention warp"], 0)
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
    lost = other / "originals/spheres/view-0001.png"
    measured = next((other / "made").glob("*/measured/cells/*/*.json"))
    lost.unlink()
    measured.write_bytes(measured.read_bytes()[:-30])
    assert "2 sealed files are missing or changed" in whole(folder, other).stderr
    assert "every hash fits" in call("verify", other).stdout
    assert files(other / "originals") == files(run / "originals")
    assert (other / "results.json").read_bytes() == (run / "results.json").read_bytes()


@pytest.fixture(scope="module")
def quick(folder):
    """A run of two methods, the weights that were loaded for it, and what was told before."""
    weights = folder / "weights" / "lpips"
    weights.mkdir()
    save_backbone(weights / "alexnet-owt-7be5be79.pth", "alex")
    shutil.copy(linear_layers() / "alex.pth", weights)
    encoders = {**MANIFEST["encoders"], "perceptual": {"folder": "weights/lpips"}}
    save(folder, {**MANIFEST, "encoders": encoders}, "quick.yaml")
    out = folder / "quick"
    lines = whole(folder, out, "--quick", "--dry-run", manifest="quick.yaml").stdout.splitlines()
    assert not (out / "cells").exists()
    loaded = []

    def spy(load, number):
        def loads(*arguments, **more):
            loaded.append(arguments[number].name)
            return load(*arguments, **more)

        return loads

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pretrained, "_load", spy(pretrained._load, 1))
        patch.setattr(lpips, "load_lpips", spy(lpips.load_lpips, 0))
        done = CliRunner().invoke(app, command(folder, out, "--quick", manifest="quick.yaml")[3:])
    assert done.exit_code == 0, done.output
    return out, loaded, lines


def test_quick_runs_two_methods_on_one_scene(quick):
    """Oracle: the files' sizes, and rows that the methods counted while they ran."""
    out, _, lines = quick
    assert lines[-1].startswith("to do: 3 cells, ") and "GB of disk" in lines[-1]
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    told = float(lines[-1].split(", ")[-1].removesuffix(" GB of disk"))
    assert told == pytest.approx(size / 1e9, rel=0.25)
    results = json.loads((out / "results.json").read_text())
    assert [(c["scene"], c["variants"]) for c in results["cells"] if c["kind"] == "edit"] == [
        ("spheres", ["attention warp"]),
        ("spheres", ["IGS2GS"]),
    ]
    for name in ("attention warp", "IGS2GS"):
        (cell,) = (c for c in results["cells"] if c["variants"] == [name])
        told = f"{name}: 1 cells, {cell['counts']['network_rows']} network rows, "
        assert any(line.startswith(told) for line in lines)


def test_two_cells_of_a_process_load_each_encoder_once(quick):
    """Once in the check, then with both preprocessings; the perceptual distance has one."""
    assert sorted(quick[1]) == 3 * ["clip"] + 3 * ["dino"] + 2 * ["lpips"]


def test_two_workers_of_a_scheduler_give_the_bytes_of_one_process(folder, quick):
    out = folder / "workers"
    place = {"dashboard_address": "127.0.0.1:0", "scheduler_kwargs": {"dashboard": False}}
    with LocalCluster(2, threads_per_worker=1, memory_limit=0, **place) as cluster:
        address = ("--scheduler", cluster.scheduler_address)
        whole(folder, out, "--quick", *address, manifest="quick.yaml")
    assert (out / "results.json").read_bytes() == (quick[0] / "results.json").read_bytes()
    assert made(out) == made(quick[0])
