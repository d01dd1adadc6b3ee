"""The whole command on two exported scenes, killed half-way and begun again."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from edit_folders import files
from PIL import Image
from small_manifest import EDIT, MANIFEST, SIZE, VIEWS, write

from attnwarp.editing.small import load_editor
from attnwarp.io import read_ply
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
    whole(folder, folder / "run")
    return folder / "run"


def records(run):
    """Cells without what was measured in seconds."""
    cells = [json.loads(p.read_bytes()) for p in sorted((run / "cells").rglob("*.json"))]
    return [{k: v for k, v in cell.items() if k not in ("seconds", "sha256")} for cell in cells]


def made(run):
    """Files of all cells but for the pages, which tell seconds, and the locks, which tell a process."""
    told = ("index.html", ".lock")
    return {k: v for k, v in files(run / "made").items() if not k.endswith(told)}


def test_a_run_that_was_killed_half_way_gives_the_same_bytes(folder, run):
    """Oracle: the run that nothing disturbed."""
    killed = folder / "killed"
    for cells in (1, 6):
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


def test_every_edit_of_the_manifest_is_there_beside_the_papers_figures(run):
    """Oracle: the manifest's published numbers; the files that were written."""
    results = json.loads((run / "results.json").read_text())
    edits = results["cells"]
    assert len(edits) == 2 * (3 + 2)  # two scenes; a method with two seeds among four
    for cell in edits:
        edited = run / "made" / cell["id"][:16] / "edited"
        assert len(list(edited.iterdir())) == cell["counts"]["edited"]
        assert cell["counts"]["views"] == VIEWS
    text = (run / "report.md").read_text()
    assert "Edit PSNR, paper" in text and "22.780" in text


def test_an_exported_scene_gives_the_studys_edited_pictures(folder, run):
    """Oracle: the study's way to edit true pictures, which never were files, by the same splats and seed."""
    loaded = load_manifest(str(folder / "manifest.yaml"))
    row = loaded.manifest.variants["attention warp"]
    scene = load_scene("spheres")
    cameras = orbit(scene, VIEWS, SIZE)
    images = [np.asarray(to_srgb(appearance(scene, c, spp=2)), np.float32) for c in cameras]
    splats = read_ply(next(run.glob("fits/spheres-2d-*/splats.ply")))
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


def test_a_dry_run_tells_the_rows_that_the_methods_then_count(folder, run):
    lines = whole(folder, folder / "dry", "--dry-run").stdout.splitlines()
    assert not (folder / "dry" / "cells").exists()
    cells = json.loads((run / "results.json").read_text())["cells"]
    for name in MANIFEST["variants"]:
        rows = [c["counts"]["network_rows"] for c in cells if c["variants"] == [name]]
        assert f"{name}: {len(rows)} cells, {sum(rows):,} network rows" in lines
    total = sum(c["counts"]["network_rows"] for c in cells)
    assert lines[-1] == f"all: {len(cells)} cells, {total:,} network rows"
