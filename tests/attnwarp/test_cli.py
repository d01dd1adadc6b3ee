"""The command line as a person meets it, in the process of the tests where that is not the point."""

import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import typer
from imported_modules import modules_after
from plyfile import PlyData
from typer.main import get_command
from typer.testing import CliRunner

import attnwarp_eval.cli.main
from attnwarp import Camera, Gaussians, reporting
from attnwarp.cli.main import app
from attnwarp.cli.options import PANELS
from attnwarp.cli.shell import COMMANDS, clear_errors
from attnwarp.io import Dataset, read_dataset, read_ply, write_ply, write_transforms
from attnwarp.render import render
from attnwarp.render.threads import set_thread_count
from attnwarp.trial import disc

ATTNWARP = [sys.executable, "-m", "attnwarp"]


@pytest.fixture(autouse=True)
def threads_as_before():
    before = torch.get_num_threads(), cv2.getNumThreads()
    yield
    torch.set_num_threads(before[0])
    cv2.setNumThreads(before[1])
    set_thread_count(None)


def in_process(*arguments):
    """Run the command without starting a process, which costs seconds of imports."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def call(*arguments):
    command = [*ATTNWARP, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder as another program would hand it over: transforms.json, images, points."""
    folder = tmp_path_factory.mktemp("data")
    random = torch.Generator().manual_seed(0)
    splats = Gaussians(
        "3d", 0.4 * torch.randn(40, 3, generator=random), torch.randn(40, 4, generator=random),
        torch.full((40, 3), 0.12), torch.full((40,), 0.9),
        Gaussians.sh_from_rgb(torch.rand(40, 3, generator=random)),
    )  # fmt: skip
    cameras, paths = [], []
    (folder / "images").mkdir()
    for k in range(9):
        yaw = 2 * np.pi * k / 9
        position = [3 * np.cos(yaw), 3 * np.sin(yaw), 0.5]
        camera = Camera.look_at(position, [0, 0, 0], width=32, height=32, fov_y=40, name=f"{k}")
        image = render(splats, camera).color.clamp(0, 1).numpy()
        path = folder / "images" / f"{k}.png"
        cv2.imwrite(str(path), np.round(255 * image[..., ::-1]).astype(np.uint8))
        cameras.append(camera)
        paths.append(path)
    colors = np.full((40, 3), 128, np.uint8)
    write_transforms(folder, Dataset(cameras, paths, splats.world_means(), colors))
    return folder


@pytest.fixture
def splat(tmp_path):
    """A file of one splat."""
    write_ply(tmp_path / "m.ply", disc(0.2))
    return tmp_path / "m.ply"


def test_help_of_every_command_imports_nothing_heavy():
    code = """
from typer.main import get_command
from typer.testing import CliRunner
from attnwarp.cli.main import app
names = sorted(get_command(app).commands)
assert {"fit", "render", "edit", "edit-image", "convert"} <= set(names)
for name in names:
    assert CliRunner().invoke(app, [name, "--help"]).exit_code == 0
"""
    heavy = {"torch", "numba", "numpy", "cv2", "scipy", "diffusers", "transformers"}
    heavy |= {"rich", "pydantic"}
    modules = modules_after(code)
    assert "attnwarp.cli.main" in modules and not modules & heavy


@pytest.mark.parametrize("program", ["attnwarp", "attnwarp_eval"])
def test_the_help_of_a_program_and_a_mistyped_option_import_nothing_heavy(program):
    command = "edit bear" if program == "attnwarp" else "run quick"
    code = f"""
from typer.testing import CliRunner
from {program}.cli.main import app
assert CliRunner().invoke(app, ["--help"]).exit_code == 0
done = CliRunner().invoke(app, {command.split()!r} + ["--stepz", "3"])
assert done.exit_code == 2 and "No such option: --stepz" in done.stderr
"""
    assert not modules_after(code) & {"torch", "numpy", "cv2", "rich", "pydantic"}


def test_the_packages_import_neither_compilers_nor_pictures_nor_networks():
    """One process, which each import leaves fuller: what the last has not, none has imported."""
    render, packages, everything = modules_after(
        "import attnwarp.render",
        "import attnwarp.fit, attnwarp.methods",
        "import attnwarp.warp, attnwarp.cli.main",
    )
    assert "attnwarp.render" in render and {"attnwarp.fit", "attnwarp.methods"} <= packages
    heavy = {"torch._dynamo", "diffusers", "transformers", "cv2", "numba", "scipy"}
    assert (render & heavy, packages & heavy) == (set(), set())
    assert "attnwarp.cli.main" in everything and "warp" not in everything


def test_the_help_has_a_section_for_each_panel_in_order():
    text = CliRunner().invoke(app, ["edit", "--help"]).stdout
    sections = re.findall(r"^(\w.*):$", text, re.M)
    assert sections == ["Arguments", "Options", *PANELS]


@pytest.mark.parametrize(
    "name", ["edit", *(pytest.param(n, marks=pytest.mark.door) for n in ("fit", "render"))]
)
def test_help_of_80_columns_cuts_no_name_and_no_word(name):
    """Oracle: the options of the command itself."""
    text = CliRunner().invoke(app, [name, "--help"], env={"COLUMNS": "80"}).stdout
    options = [o for p in get_command(app).commands[name].params for o in p.opts]
    assert [o for o in options if o.startswith("-") and not re.search(rf"\s{o}\s", text)] == []
    assert "…" not in text and max(map(len, text.splitlines())) <= 80
    assert len(text.splitlines()) < 180


def test_a_choice_that_is_none_is_told_in_the_words_of_the_command_line(tmp_path):
    done = CliRunner().invoke(app, ["fit", str(tmp_path), "--kind", "foo"], env={"COLUMNS": "120"})
    assert done.exit_code == 2
    assert "Invalid value for '--kind': 'foo' is not one of '2dgs', '3dgs'." in done.stderr


def test_mistyped_words_are_answered_before_anything_heavy_is_imported(tmp_path):
    edit = ["edit", "data", "--out", str(tmp_path / "out"), "--instruction"]
    image = ["edit-image", "a.png", "--out", str(tmp_path / "a.png"), "--instruction"]
    wrong = {
        "instruction: is empty": [[*edit, " "], [*image, " "]],
        "editor 'smal': neither": [[*c, "red", "--editor", "smal"] for c in (edit, image)],
        "takes depth maps": [[*image, "red", "--editor", "small-depth"]],
    }
    code = f"""
from typer.testing import CliRunner
from attnwarp.cli.main import app
for message, calls in {wrong!r}.items():
    for call in calls:
        done = CliRunner().invoke(app, call)
        assert done.exit_code == 2 and message in done.stderr, (call, done.stderr)
"""
    modules = modules_after(code)
    assert "attnwarp.cli.main" in modules and not modules & {"torch", "cv2", "diffusers"}


def test_fit_and_render_do_what_they_say(data, tmp_path):
    out = tmp_path / "fit"
    done = in_process(
        "fit",
        data,
        "--threads",
        1,
        "--kind",
        "2dgs",
        "--out",
        out,
        "--iterations",
        60,
        "--set",
        "sh_degree=0",
        "--set",
        "evaluate_every=20",
        "--set",
        "sky=false",
    )
    assert done.exit_code == 0, done.stderr
    assert "splats.ply: " in done.stdout and "held-out PSNR" in done.stdout
    assert "loss" in done.stderr and "PSNR" in done.stderr  # plain lines, as there is no terminal
    history = [json.loads(line) for line in (out / "history.jsonl").read_text().splitlines()]
    assert [record["iteration"] for record in history] == [0, 20, 40, 60]
    assert history[-1]["psnr"] > history[0]["psnr"]
    assert json.loads((out / "settings.json").read_text())["iterations"] == 60
    splats = read_ply(out / "splats.ply")
    assert splats.kind == "2d"
    # Of 9 views the fifth is held out; picture and render side by side.
    assert [p.name for p in (out / "held_out").iterdir()] == ["4.png"]
    picture, drawn = np.split(cv2.imread(str(out / "held_out" / "4.png")).astype(float), 2, axis=1)
    assert picture.shape == (32, 32, 3)
    # Colours rounded to 8 bits: each off by half a step of 255 at most.
    said = float(done.stdout.split("held_out/4.png: ")[1].split(" dB")[0])
    error = np.sqrt(((picture - drawn) ** 2).mean())
    assert said == pytest.approx(20 * np.log10(255 / error), abs=20 * np.log10(1 + 0.6 / error))
    assert f"held-out PSNR {said:.2f} dB" in done.stdout  # of all, here of one

    pictures = tmp_path / "pictures"
    done = in_process(
        "render",
        out / "splats.ply",
        data,
        "--out",
        pictures,
        "--depth",
        "--normal",
        "--background",
        "0.2,0.4,1",
    )
    assert done.exit_code == 0, done.stderr
    assert len(list(pictures.iterdir())) == 27
    image = cv2.imread(str(pictures / "3.png"))
    # One step of 8 bits: the rim of a splat may reach into the corner.
    np.testing.assert_allclose(image[0, 0].astype(int), [255, 102, 51], atol=1)
    depth = np.load(pictures / "3.depth.npy")
    assert depth.shape == (32, 32) and 2 < np.nanmedian(depth) < 4


def test_a_fit_of_other_settings_names_the_options_that_begin_again(data, tmp_path):
    arguments = ("fit", data, "--out", tmp_path, "--max-size", 16, "--hold-out", 0)
    assert in_process(*arguments, "--iterations", 1).exit_code == 0
    longer = in_process(*arguments, "--iterations", 2)
    assert longer.exit_code == 0 and "planned with 1 iterations goes on to 2" in longer.stderr
    result = in_process(*arguments, "--iterations", 2, "--seed", 1)
    assert result.exit_code == 2
    assert "seed: 0, now 1" in result.stderr
    assert f"remove {tmp_path / 'checkpoint.pt'}" in result.stderr
    # What it advises is what it has.
    assert "--restart" in result.stderr and "--start SPLATS.ply" in result.stderr
    (tmp_path / "checkpoint.pt").write_bytes(b"damaged")
    assert "--restart" in in_process(*arguments, "--iterations", 2).stderr
    assert in_process(*arguments, "--iterations", 2, "--restart").exit_code == 0
    (tmp_path / "checkpoint.pt").unlink()
    before = (tmp_path / "splats.ply").read_bytes()
    result = in_process(*arguments, "--iterations", 2)
    assert result.exit_code == 2 and "--restart" in result.stderr
    assert (tmp_path / "splats.ply").read_bytes() == before


def test_a_fit_writes_over_no_picture_that_it_reads(data, tmp_path):
    shutil.copytree(data, tmp_path / "data")
    (tmp_path / "data" / "images").rename(tmp_path / "data" / "held_out")
    path = tmp_path / "data" / "transforms.json"
    path.write_text(path.read_text().replace("images/", "held_out/"))
    before = {p: p.read_bytes() for p in (tmp_path / "data").rglob("*.*")}
    done = in_process("fit", tmp_path / "data", "--out", tmp_path / "data", "--iterations", 1)
    assert done.exit_code == 2 and "held_out/4.png: is read, and a result" in done.stderr
    assert {p: p.read_bytes() for p in (tmp_path / "data").rglob("*.*")} == before


def test_a_restart_that_is_refused_leaves_the_checkpoint(tmp_path):
    view = Camera.look_at([3, 0, 0.5], [0, 0, 0], width=60, height=30, fov_y=40, name="a")
    cv2.imwrite(str(tmp_path / "a.png"), np.full((30, 60, 3), 128, np.uint8))
    write_transforms(tmp_path, Dataset([view], [tmp_path / "a.png"]))
    out = tmp_path / "fit"
    arguments = ("fit", tmp_path, "--out", out, "--hold-out", 0, "--iterations", 1)
    assert in_process(*arguments).exit_code == 0
    before = (out / "checkpoint.pt").read_bytes()
    done = in_process(*arguments, "--restart", "--max-size", 16)  # 16 x 8 px
    assert done.exit_code == 2 and "SSIM needs 11 a side" in done.stderr
    assert (out / "checkpoint.pt").read_bytes() == before


def test_an_infinite_psnr_is_null_in_the_history(data, tmp_path):
    """A view that looks away, of a black picture, is met exactly."""
    shutil.copytree(data, tmp_path / "data")
    there = read_dataset(tmp_path / "data")
    away = Camera.look_at([0, 0, 50], [0, 0, 99], width=32, height=32, fov_y=40, up=(1, 0, 0))
    held_out = replace(away, name=there.cameras[1].name)
    cv2.imwrite(str(there.image_paths[1]), np.zeros((32, 32, 3), np.uint8))
    cameras = [there.cameras[0], held_out, *there.cameras[2:]]
    write_transforms(
        tmp_path / "data", Dataset(cameras, there.image_paths, there.points, there.colors)
    )
    done = in_process(
        "fit", tmp_path / "data", "--out", tmp_path / "fit", "--iterations", 1,
        "--hold-out", Path(held_out.name).name,
    )  # fmt: skip
    assert done.exit_code == 0, done.output

    def refuse(constant):
        raise AssertionError(constant)

    lines = (tmp_path / "fit" / "history.jsonl").read_text().splitlines()
    assert [json.loads(line, parse_constant=refuse)["psnr"] for line in lines][-1] is None


def test_a_fit_goes_on_from_fitted_splats(data, tmp_path):
    """Oracle: the held-out PSNR at which the first fit ended, through a PLY in float32."""

    def history(name):
        lines = (tmp_path / name / "history.jsonl").read_text().splitlines()
        return [json.loads(line)["psnr"] for line in lines]

    once = ("--threads", 1, "--iterations", 30, "--set", "background=random")
    flat = ("--kind", "2dgs", "--set", "sh_degree=1", "--set", "sh_every=0.33")
    assert in_process("fit", data, *once, *flat, "--out", tmp_path / "a").exit_code == 0
    splats = tmp_path / "a" / "splats.ply"
    done = in_process("fit", data, *once, "--start", splats, "--out", tmp_path / "b")
    assert done.exit_code == 0, done.stderr
    assert history("b")[0] == pytest.approx(history("a")[-1], abs=1e-3)
    assert history("b")[-1] > history("b")[0]
    assert read_ply(tmp_path / "b" / "splats.ply").sh_degree == 3

    done = in_process("fit", data, *once, "--start", splats, "--out", tmp_path / "a")
    assert done.exit_code == 2 and f"--start: the fit would write over {splats}" in done.stderr
    far = tmp_path / "far.ply"
    write_ply(far, Gaussians(**{**vars(disc(0.2)), "means": torch.full((1, 3), 900.0)}))
    done = in_process("fit", data, *once, "--start", far, "--out", tmp_path / "c")
    assert done.exit_code == 2 and "cover less than" in done.stderr

    few = ("--start", splats, "--max-splats", 1)
    done = in_process("fit", data, *once, *few, "--out", tmp_path / "c")
    assert done.exit_code == 2 and "--max-splats: got 1, but" in done.stderr
    done = in_process("fit", data, *once, "--start", splats, "--points", 9, "--out", tmp_path / "c")
    assert done.exit_code == 2 and "--points: got 9, but --start names" in done.stderr

    # The kind is the file's, or the one that is asked for.
    full = tmp_path / "full.ply"
    round_one = {**vars(disc(0.2)), "kind": "3d", "scales": torch.full((1, 3), 0.2)}
    write_ply(full, Gaussians(**round_one))
    for asked, kind in (((), "3d"), (("--kind", "2dgs"), "2d")):
        out = tmp_path / kind
        done = in_process("fit", data, *once, "--start", full, *asked, "--out", out)
        assert done.exit_code == 0, done.stderr
        assert json.loads((out / "settings.json").read_text())["kind"] == kind


def test_held_out_views_that_become_worse_choose_the_splats_of_before(data, tmp_path):
    """All pictures are white but the four that are held out: the fit leaves them behind, and the
    splats are kept of before."""
    shutil.copytree(data, tmp_path / "data")
    for path in (tmp_path / "data" / "images").iterdir():
        level = 0 if path.stem in "1234" else 255
        cv2.imwrite(str(path), np.full((32, 32, 3), level, np.uint8))
    fit = ["fit", tmp_path / "data", "--out", tmp_path / "out", "--set", "evaluate_every=10"]
    fit += ["--iterations", 30, "--set", "densify=false", "--set", "lr_opacity=0.2"]
    done = in_process(*fit, "--hold-out", "1,2,3,4.png")
    assert done.exit_code == 0, done.stderr
    history = (tmp_path / "out" / "history.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in history]
    assert rows[0]["choosing"] > rows[-1]["choosing"]
    assert f"held-out PSNR {rows[0]['psnr']:.2f} dB" in done.stdout
    assert done.stdout.count("one that chose the splats") == 3
    assert "too few to choose by" not in done.stderr

    cv2.imwrite(str(tmp_path / "data" / "images" / "4.png"), np.full((32, 32, 3), 255, np.uint8))
    fit[3] = tmp_path / "few"
    done = in_process(*fit, "--hold-out", "1,2,3.png")
    assert "held-out views: 3, too few to choose by" in done.stderr
    assert "one that chose" not in done.stdout


def test_views_without_pictures_are_neither_fitted_on_nor_held_out(data, tmp_path):
    shutil.copytree(data, tmp_path / "data")
    (tmp_path / "data" / "images" / "4.png").unlink()  # the fifth by name would be held out
    done = in_process(
        "fit", tmp_path / "data", "--out", tmp_path / "out", "--missing-images", "none",
        "--iterations", "2", "--set", "densify=false",
    )  # fmt: skip
    assert done.exit_code == 0, done.stderr
    assert [path.name for path in (tmp_path / "out" / "held_out").iterdir()] == ["5.png"]


def start_and_wait_for_a_checkpoint(arguments, out):
    process = subprocess.Popen(
        [*ATTNWARP, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    end = time.monotonic() + 100
    while not (out / "checkpoint.pt").exists():
        assert process.poll() is None and time.monotonic() < end, process.communicate()
        time.sleep(0.05)
    return process


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (signal.SIGINT, 130),
        pytest.param(signal.SIGKILL, -9, marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, 130, marks=pytest.mark.slow),
    ],
)
def test_a_fit_that_is_stopped_keeps_what_it_has_and_goes_on(data, tmp_path, number, code):
    out = tmp_path / "fit"
    long = [
        "fit", data, "--threads", 1, "--out", out, "--set", "sh_degree=0", "--iterations", "200000",
        "--checkpoint-seconds", "0.05",
    ]  # fmt: skip
    process = start_and_wait_for_a_checkpoint(long, out)
    process.send_signal(number)
    process.communicate(timeout=100)
    assert process.returncode == code
    # A kill leaves the checkpoint alone, from which the next run goes on.
    assert number == signal.SIGKILL or len(read_ply(out / "splats.ply")) > 0
    done = in_process(*long, "--max-seconds", "0.1")
    assert done.exit_code == 0, done.stderr
    assert "iterations in" in done.stdout


@pytest.mark.door
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        # No name of a scene: no hint.
        (["fit", "nowhere", "--out", "{out}"], "nowhere: no such file or folder\n"),
        (["fit", "bear", "--out", "{out}"], "for a scene: attnwarp-eval scenes export bear DIR"),
        (
            ["fit", "scenes/bear.yaml", "--out", "{out}"],
            "for a scene: attnwarp-eval scenes export scenes/bear.yaml DIR",
        ),
        (["fit", "{data}", "--out", "{out}", "--set", "lr_mean=1"], "did you mean 'lr_means'"),
        (["fit", "{data}", "--out", "{out}", "--set", "ssim"], "expected NAME=VALUE"),
        (["fit", "{data}", "--out", "{out}", "--set", "kind=3d"], "--kind"),
        (["fit", "{data}", "--out", "{out}", "--hold-out", "1"], "leaves nothing to fit on"),
        (["fit", "{data}", "--out", "{out}", "--seed", "9" * 400], "9... (400 characters)"),
        (["fit", "{data}", "--out", "{out}", "--kind", "4dgs"], "4dgs"),
        (["render", "nowhere.ply", "{data}", "--out", "{out}"], "nowhere.ply: no such file"),
        (["render", "{data}/images/0.png", "{data}", "--out", "{out}"], "0.png"),
        (
            ["render", "{data}/sparse_pc.ply", "{data}", "--out", "{out}", "--background", "blue"],
            "--background",
        ),
    ],
)
def test_what_cannot_be_used_ends_in_one_clear_line_and_code_2(data, tmp_path, arguments, message):
    done = in_process(*(a.format(data=data, out=tmp_path / "out") for a in arguments))
    assert done.exit_code == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.door
@pytest.mark.parametrize("command", ["fit", "render"])
def test_an_out_that_cannot_be_a_folder_ends_in_one_clear_line(data, tmp_path, command, splat):
    taken = tmp_path / "taken"
    taken.write_text("not to be lost")
    first = [data] if command == "fit" else [splat, data]
    long = tmp_path / ("n" * 300)
    for out, message in [
        (taken, f"{taken}: --out is a file, expected a folder"),
        (taken / "below", f"{taken / 'below'}: Not a directory; check the path"),
        (long, f"{long}: File name too long; check the path"),
    ]:
        done = in_process(command, *first, "--out", out)
        assert done.exit_code == 2, (out, done.exception)
        assert message in done.stderr
    assert taken.read_text() == "not to be lost"


@pytest.mark.parametrize("command", ["fit", "render"])
def test_a_disk_without_room_ends_in_one_clear_line(data, tmp_path, command, splat):
    """No file may grow beyond 100 bytes, which to a writer is what a full disk is."""
    arguments = [data, "--iterations", 1] if command == "fit" else [splat, data]
    # Once without the limit, lest it be numba's cache of compiled kernels that finds the disk full.
    assert in_process(command, *arguments, "--out", tmp_path / "warm").exit_code == 0
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        done = in_process(command, *arguments, "--threads", 1, "--out", tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert done.exit_code == 2, done.stderr
    assert "Traceback" not in done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert (
        last.startswith(f"attnwarp: {tmp_path / 'out'}")
        and "File too large; check the path, the space" in last
    )
    assert not list((tmp_path / "out").iterdir())  # nor is half a file left


@pytest.mark.slow
def test_a_bundled_scene_is_edited_by_its_name_inside_an_exact_mask(tmp_path, monkeypatch):
    """Oracle: outside the exported mask of the ball, edited views are the pictures before."""
    monkeypatch.chdir(tmp_path)
    quick = ["--stages", 1, "--steps", 2, "--iterations", 1]
    words = "make the beach ball red"
    done = in_process("edit", "spheres", "--instruction", words, *quick)
    assert done.exit_code == 0, done.stderr
    out = tmp_path / "runs" / "edits" / "spheres-make-the-beach-ball-red"
    data = read_dataset(out / "scene")
    edited = {path.name: path for path in (out / "rounds").glob("*/*.png")}
    assert len(data.cameras) == 24 and len(edited) > 4
    outside, inside = [], []
    for camera, path in zip(data.cameras, data.image_paths, strict=True):
        name = f"{Path(camera.name).stem}.png"
        if name in edited:
            mask = cv2.imread(str(out / "scene" / "masks" / "beach_ball" / name))[..., 0]
            # A latent is four pixels wide: its pixels go with the mask.
            near = cv2.dilate(mask, np.ones((9, 9), np.uint8)) > 0
            change = np.abs(cv2.imread(str(edited[name])).astype(int) - cv2.imread(str(path)))
            outside.append(change[~near].max())
            inside.extend(change[mask > 0].ravel())
    assert max(outside) <= 1 < np.mean(inside)
    assert "attnwarp fit more --out fit" in (out / "index.html").read_text()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--at", "300,3"), "--at: got 300,3, expected px inside the picture of 128 x 128"),
        *(
            pytest.param(more, message, marks=pytest.mark.door)
            for more, message in (
                (
                    ("--source", "24"),
                    "--source: got '24', expected a view's name or a number below",
                ),
                (("--ply", "no.ply"), "no.ply: no such file"),
                (("--mask", "no.png"), "no.png: no such file"),
                (("--where", "bear", "--segmenter", "a,b"), "a: no such folder"),
                (("--dtype", "f8"), "dtype 'f8': unknown"),
                (("--device", "tpu"), "device 'tpu': unknown"),
                (("--turntable", "a.avi"), "--turntable: got a.avi, expected a name ending in"),
                (("--set", "nonsense=1"), "nonsense"),
            )
        ),
    ],
)
def test_what_cannot_be_used_is_refused_before_a_bundled_scene_is_edited(more, message, tmp_path):
    done = in_process(
        "edit", "bear", "--instruction", "make it red", "--out", tmp_path / "out", *more
    )
    assert done.exit_code == 2 and message in done.stderr
    assert {*tmp_path.glob("out/*")} <= {tmp_path / "out" / "scene"}


@pytest.mark.door
def test_a_misspelt_scene_and_a_command_of_the_other_program_are_named(data, tmp_path):
    done = in_process("edit", "baer", "--instruction", "make it red", "--out", tmp_path / "out")
    assert "baer: no such file or folder; did you mean 'bear'?" in done.stderr
    (tmp_path / "photos").mkdir()
    done = in_process("fit", tmp_path / "photos", "--out", tmp_path / "out")
    assert "photographs get poses first, by attnwarp poses" in done.stderr
    programs = {"attnwarp": app, "attnwarp-eval": attnwarp_eval.cli.main.app}
    names = {name: {*get_command(program).commands} for name, program in programs.items()}
    for name, other in (tuple(names), tuple(reversed(names))):
        assert {*COMMANDS[name]} == names[name] - names[other]
        command = COMMANDS[name][0]
        done = CliRunner().invoke(programs[other], [command, "a b"])
        assert (
            done.exit_code == 2 and f"is a command of {name}: {name} {command} 'a b'" in done.stderr
        )


def test_render_needs_no_points(data, tmp_path, splat):
    colmap = tmp_path / "colmap"
    colmap.mkdir()
    (colmap / "cameras.txt").write_text("1 PINHOLE 8 6 10 10 4 3\n")
    (colmap / "images.txt").write_text("1 1 0 0 0 0 0 3 1 front.png\n\n")
    for cloud in (b"", b"damaged"):
        (colmap / "points3D.txt").write_bytes(cloud)
        done = in_process("render", splat, colmap, "--out", tmp_path / "out")
        assert done.exit_code == 0, done.stderr
        assert cv2.imread(str(tmp_path / "out" / "front.png")).shape == (6, 8, 3)
    # A transforms.json whose points were not copied along.
    alone = tmp_path / "transforms.json"
    alone.write_bytes((data / "transforms.json").read_bytes())
    assert "ply_file_path" in alone.read_text()
    done = in_process("render", splat, alone, "--out", tmp_path / "out", "--size", "16")
    assert done.exit_code == 0, done.stderr


def test_render_says_where_no_view_shows_a_splat(data, tmp_path):
    for name, shift, expected in (("there.ply", 0.0, 0), ("far.ply", 50.0, 1)):
        splat = disc(0.2)
        write_ply(tmp_path / name, replace(splat, means=splat.means + torch.tensor([0, 0, shift])))
        out = tmp_path / name.removesuffix(".ply")
        done = in_process("render", tmp_path / name, data, "--out", out)
        assert done.exit_code == 0, done.stderr
        pictures = [cv2.imread(str(path)) for path in out.glob("*.png")]
        assert len(pictures) == 9 and any(picture.any() for picture in pictures) == (not expected)
        said = f"warning: {tmp_path / name}: no view shows any of its splats beyond --near 0.033;"
        assert done.stderr.count(said) == expected  # 0.01 of 1.1 times the cameras' circle of 3


def test_what_render_cuts_does_not_depend_on_the_scenes_units(data, tmp_path):
    """Oracle: the same scene in units of its own, a floater at a 150th of its distance included."""
    dataset, splat, pictures = read_dataset(data), disc(0.2), []
    eye = torch.tensor(dataset.cameras[0].position).float()
    floater = eye * (1 - 0.02 / eye.norm())
    for times in (1.0, 1 / 64, 4.0, 64.0):
        both = Gaussians(
            "2d",
            times * torch.stack([splat.means[0], floater]),
            torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
            times * torch.tensor([[0.2, 0.2], [0.01, 0.01]]),
            torch.ones(2),
            torch.tensor([[[0.5, 0.5, 0.5]], [[1.5, -1.5, -1.5]]]),
        )
        cameras = []
        for camera in dataset.cameras:
            pose = camera.world_to_camera.copy()
            pose[:3, 3] *= times
            cameras.append(replace(camera, world_to_camera=pose))
        folder = tmp_path / str(times)
        folder.mkdir()
        write_ply(folder / "m.ply", both)
        write_transforms(folder, Dataset(cameras, dataset.image_paths))
        done = in_process("render", folder / "m.ply", folder, "--out", folder / "out")
        assert done.exit_code == 0, done.stderr
        pictures.append(cv2.imread(str(folder / "out" / "0.png")))
    assert pictures[0][16, 16].min() > 0  # the first splat, not the red floater before it
    for picture in pictures[1:]:
        assert np.array_equal(picture, pictures[0])


def test_render_says_how_far_it_is(data, tmp_path, monkeypatch, splat):
    """Oracle: a line a view where the time between lines is 0, and the last one in any case."""
    for seconds, counts in ((0.0, range(1, 10)), (100.0, [9])):
        monkeypatch.setattr(reporting, "LINE_SECONDS", seconds)
        done = in_process("render", splat, data, "--out", tmp_path / "views")
        assert re.findall(r"^views \[(\d+)/9\]", done.stderr, re.M) == [str(k) for k in counts]


@pytest.mark.parametrize("way", ["itself", "through a link", "from a link"])
def test_render_leaves_the_photographs_of_its_cameras_alone(way, data, tmp_path, splat):
    """Oracle: the photographs' bytes."""
    capture = shutil.copytree(data, tmp_path / "capture")
    images, out = capture / "images", capture / "images"
    if way == "through a link":
        out = tmp_path / "link"
        out.symlink_to(images)
    elif way == "from a link":
        out = shutil.move(images, tmp_path / "photographs")
        images.mkdir()
        for path in out.iterdir():
            (images / path.name).symlink_to(path)
    before = {path.name: path.read_bytes() for path in images.iterdir()}
    done = in_process("render", splat, capture, "--out", out)
    assert done.exit_code == 2
    assert "0.png: is read, and a result would replace it; name another folder" in done.stderr
    assert {path.name: path.read_bytes() for path in images.iterdir()} == before
    assert {path.name for path in out.iterdir()} == set(before)


@pytest.mark.parametrize("name", ["edited.ply", "edited-3dgs.ply"])
def test_an_edit_leaves_the_splats_that_it_is_given_alone(name, data, tmp_path):
    path, link = tmp_path / name, tmp_path / "out" / name
    path.write_bytes(b"a person's own")
    link.parent.mkdir()
    link.symlink_to(path)  # the file that a link leads to is the result's
    for result in (path, link):
        done = in_process(
            "edit", data, "--instruction", "red", "--out", result.parent, "--ply", path
        )
        assert done.exit_code == 2
        assert f"{result}: is read, and a result would replace it" in done.stderr
    assert path.read_bytes() == b"a person's own"
    assert set(tmp_path.iterdir()) == {path, link.parent} and [*link.parent.iterdir()] == [link]


def test_views_of_the_same_file_name_do_not_overwrite_each_other(data, tmp_path, splat):
    cameras = [
        Camera.look_at([3, 0, z], [0, 0, 0], width=8, height=8, fov_y=40, name=f"{side}/a.png")
        for z, side in ((0, "left"), (1, "right"))
    ]
    write_transforms(tmp_path / "c.json", Dataset(cameras, [None, None]))
    done = in_process(
        "render", splat, tmp_path / "c.json", "--out", tmp_path / "out", "--size", "16"
    )
    assert done.exit_code == 0, done.stderr
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["0000-a.png", "0001-a.png"]
    assert cv2.imread(str(tmp_path / "out" / "0000-a.png")).shape == (16, 16, 3)


# -------- data sets that need a word more


def test_a_folder_of_both_formats_and_images_of_another_size_have_their_flags(data, tmp_path):
    both = tmp_path / "both"
    shutil.copytree(data, both)
    (both / "sparse").mkdir()
    (both / "sparse/cameras.txt").write_text("1 PINHOLE 16 16 20 20 8 8\n")
    (both / "sparse/images.txt").write_text(
        "1 1 0 0 0 0 0 3 1 0.png\n\n2 1 0 0 0 0 0 3 1 x.png\n\n"
    )
    once = ["fit", both, "--out", tmp_path / "out", "--iterations", 1, "--hold-out", 0]
    for flags, message in [
        ([], "(--format)"),
        (["--format", "colmap"], "(--missing-images none)"),
        (["--format", "colmap", "--missing-images", "none"], "(--resize-cameras)"),
        (["--format", "transforms", "--images", both], "(--images): only COLMAP"),
    ]:
        done = in_process(*once, *flags)
        assert done.exit_code == 2 and message in done.stderr, done.stderr
    flags = ["--format", "colmap", "--missing-images", "none", "--resize-cameras"]
    done = in_process(*once, *flags, "--points", 20)
    assert done.exit_code == 0, done.stderr


def test_smaller_copies_of_the_images_are_taken_by_their_scale(data, tmp_path, splat):
    small = tmp_path / "data"
    shutil.copytree(data, small)
    (small / "images_2").mkdir()
    for path in (small / "images").iterdir():
        image = cv2.imread(str(path))
        half = (image.shape[1] // 2, image.shape[0] // 2)
        cv2.imwrite(str(small / "images_2" / path.name), cv2.resize(image, half))
    done = in_process("render", splat, small, "--scale", 2, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    assert cv2.imread(str(next((tmp_path / "out").iterdir()))).shape[:2] == half[::-1]
    done = in_process("render", splat, small, "--scale", 3, "--out", tmp_path / "out")
    assert done.exit_code == 2 and "(--scale): got 3, expected one of 1, 2, 4, 8" in done.stderr
    done = in_process("render", splat, small, "--scale", 4, "--out", tmp_path / "out")
    assert done.exit_code == 2 and "images_4" in done.stderr


def test_masks_are_not_passed_over_silently(data, tmp_path, splat):
    text = json.loads((data / "transforms.json").read_text())
    text["frames"][2]["mask_path"] = "masks/2.png"
    (data / "masked.json").write_text(json.dumps(text))
    command = ["render", splat, data / "masked.json", "--out", tmp_path / "out"]
    done = in_process(*command)
    assert done.exit_code == 2 and "--ignore-key mask_path" in done.stderr
    done = in_process(*command, "--ignore-key", "mask_path")
    assert done.exit_code == 0
    assert done.stderr.splitlines() == ["out [9/9] done"]


def test_undistort_makes_a_data_set_that_fit_takes(data, tmp_path):
    text = json.loads((data / "transforms.json").read_text())
    (data / "bent.json").write_text(json.dumps({**text, "k1": -0.5}))
    fit = ["fit", "--iterations", 1, "--out", tmp_path / "fit"]
    done = in_process(*fit, data / "bent.json")
    assert done.exit_code == 2 and "attnwarp undistort DATA OUT" in done.stderr
    done = in_process("undistort", data / "bent.json", tmp_path / "flat")
    assert done.exit_code == 0, done.stderr
    assert "9 pictures, 9 of them undistorted" in done.stdout
    assert in_process(*fit, tmp_path / "flat").exit_code == 0


# -------- convert


def spread(kind="2d", origin=(0.0, 0.0, 0.0)):
    random = torch.Generator().manual_seed(1)
    return Gaussians(
        kind,
        torch.randn(20, 3, generator=random),
        torch.randn(20, 4, generator=random),
        0.1 + torch.rand(20, 2 if kind == "2d" else 3, generator=random),
        torch.rand(20, generator=random),
        torch.randn(20, 16, 3, generator=random),
        origin=np.array(origin),
    )


def test_convert_makes_thin_3dgs_of_2dgs_and_cuts_harmonics(tmp_path):
    g = spread()
    write_ply(tmp_path / "a.ply", g)
    done = in_process(
        "convert", tmp_path / "a.ply", tmp_path / "b.ply", "--third-scale", "1e-6", "--sh-degree", 1
    )
    assert done.exit_code == 0 and "b.ply: 20 splats" in done.stdout
    vertex = PlyData.read(tmp_path / "b.ply")["vertex"]
    np.testing.assert_allclose(vertex["scale_2"], np.log(1e-6), rtol=1e-6)
    assert [p.name for p in vertex.properties if p.name.startswith("f_rest")] == [
        f"f_rest_{i}" for i in range(9)
    ]
    # f_rest is channel by channel: the first of green is coefficient 1 of green.
    np.testing.assert_array_equal(vertex["f_rest_3"], g.sh[:, 1, 1].numpy())
    as_solid = in_process("convert", tmp_path / "b.ply", tmp_path / "c.ply", "--kind", "3dgs")
    assert as_solid.exit_code == 0 and read_ply(tmp_path / "c.ply").kind == "3d"


def test_convert_takes_the_origin_out_and_in(tmp_path):
    g = spread(origin=(1e6, 0.0, 0.0))
    write_ply(tmp_path / "a.ply", g, coordinates="relative")
    done = in_process("convert", tmp_path / "a.ply", tmp_path / "b.ply")
    assert done.exit_code == 0 and "warning" in done.stderr and "--coordinates" in done.stderr
    assert np.array_equal(read_ply(tmp_path / "b.ply").origin, g.origin)
    done = in_process("convert", tmp_path / "a.ply", tmp_path / "c.ply", "--coordinates", "world")
    assert done.exit_code == 0 and "move" in done.stderr
    assert (read_ply(tmp_path / "c.ply").origin == 0).all()
    np.testing.assert_allclose(PlyData.read(tmp_path / "c.ply")["vertex"]["x"], 1e6, atol=5)
    done = in_process("convert", tmp_path / "a.ply", tmp_path / "d.splat")
    assert done.exit_code == 2 and "--coordinates relative" in done.stderr


def test_convert_to_splat_and_back(tmp_path):
    write_ply(tmp_path / "a.ply", spread("3d"))
    assert in_process("convert", tmp_path / "a.ply", tmp_path / "b.splat").exit_code == 0
    assert in_process("convert", tmp_path / "b.splat", tmp_path / "c.ply").exit_code == 0
    back = read_ply(tmp_path / "c.ply")
    assert (back.kind, len(back), back.sh_degree) == ("3d", 20, 0)
    key = lambda g: np.sort(g.world_means()[:, 0])  # noqa: E731
    np.testing.assert_array_equal(key(back), key(spread("3d")))


@pytest.mark.door
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{a}", "{out}.obj"], "ending in .ply, .splat"),
        (["{a}", "{out}.ply", "--third-scale", "1"], "--third-scale"),
        (["{none}", "{out}.ply"], "no such file"),
    ],
)
def test_convert_says_what_it_cannot_do(tmp_path, arguments, message):
    write_ply(tmp_path / "a.ply", spread("3d"))
    names = {"a": tmp_path / "a.ply", "out": tmp_path / "out", "none": tmp_path / "none.ply"}
    done = in_process("convert", *(a.format(**names) for a in arguments))
    assert done.exit_code == 2 and message in done.stderr


def test_what_is_read_is_not_written_over_by_its_name_or_a_link(data, tmp_path):
    path = tmp_path / "a.ply"
    write_ply(path, spread("3d"))
    before = path.read_bytes()
    (tmp_path / "soft.ply").symlink_to(path)
    os.link(path, tmp_path / "hard.ply")
    for name in ("a.ply", "./a.ply", "soft.ply", "hard.ply"):
        done = in_process("convert", path, f"{tmp_path}/{name}", "--sh-degree", 0)
        assert done.exit_code == 2 and "is the file to convert; choose another" in done.stderr
    assert path.read_bytes() == before
    frames = (data / "transforms.json").read_bytes()
    for named in (data, data / "transforms.json"):
        done = in_process("undistort", named, data)
        assert done.exit_code == 2 and "is the folder to undistort; choose" in done.stderr
    assert (data / "transforms.json").read_bytes() == frames


def test_a_fit_writes_world_coordinates_and_says_what_has_no_surface(data, tmp_path):
    done = in_process("fit", data, "--out", tmp_path, "--iterations", 1, "--set", "sky=false")
    assert done.exit_code == 0, done.stderr
    # Splats that begin at an opacity of 0.1 hide nothing.
    assert "% of the pictures' area has no surface" in done.stdout
    # The blobs are scattered by 0.4 about zero.
    assert abs(np.mean(PlyData.read(tmp_path / "splats.ply")["vertex"]["x"])) < 0.5


# -------- pipes, disks, signals, packages


def test_a_polite_kill_says_what_is_kept(data, tmp_path, monkeypatch, splat):
    """In the middle of a render: after the first of the pictures was written."""
    from attnwarp.io import images

    encode = images.encode_png

    def killed(rgb):
        if (tmp_path / "out" / "0.png").exists():
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(1)
        return encode(rgb)

    monkeypatch.setattr(images, "encode_png", killed)
    done = in_process("render", splat, data, "--out", tmp_path / "out")
    assert done.exit_code == 130
    assert done.stderr.startswith(f"attnwarp: stopped; the files in {tmp_path / 'out'} are whole")
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["0.png"]


def test_the_help_of_edit_names_every_method_and_preset(monkeypatch):
    """It names them in words of its own, since importing them would import torch."""
    from attnwarp.methods import PRESETS

    monkeypatch.setenv("COLUMNS", "400")
    said = in_process("edit", "--help").output
    assert [name for name in (*PRESETS, *PRESETS["attention_warping"]) if name not in said] == []


@pytest.mark.door
def test_a_missing_package_is_named(data, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    done = in_process("undistort", data, tmp_path / "flat")
    assert done.exit_code == 2 and "needs the package cv2: pip install cv2" in done.stderr


@pytest.mark.door
def test_a_command_that_is_stopped_before_it_made_its_folder_says_so(tmp_path, capsys):
    for there, expected in (
        (False, "stopped; nothing was written"),
        (True, "what it holds is whole"),
    ):
        out = tmp_path / "out"
        if there:
            out.mkdir()
        with pytest.raises(typer.Exit) as caught, clear_errors("what it holds is whole", out):
            raise KeyboardInterrupt
        assert caught.value.exit_code == 130
        assert capsys.readouterr().err == f"attnwarp: {expected}\n"
