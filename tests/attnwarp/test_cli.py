"""The command line as a person meets it: in a process of its own, with files on disk."""

import functools
import json
import resource
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from attnwarp import Camera, Gaussians
from attnwarp.cli import app
from attnwarp.io import Dataset, read_ply, write_ply, write_transforms
from attnwarp.render import render
from attnwarp.render.threads import set_thread_count

ATTNWARP = [sys.executable, "-m", "attnwarp.cli"]


@pytest.fixture(autouse=True)
def threads_as_before():
    before = torch.get_num_threads(), cv2.getNumThreads()
    yield
    torch.set_num_threads(before[0])
    cv2.setNumThreads(before[1])
    set_thread_count(None)


def in_process(*arguments):
    """The same command without starting a process, which costs seconds of imports."""
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


def one_splat():
    return Gaussians(
        "2d",
        torch.zeros(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 2), 0.2),
        torch.ones(1),
        torch.zeros(1, 1, 3),
    )


def test_help_answers_at_once():
    spent = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = call("--help")
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert done.returncode == 0 and "fit" in done.stdout
        # CPU time: on a busy machine the time on the wall is that of the others.
        spent.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert min(spent) < 0.5


def test_help_imports_nothing_heavy():
    code = (
        "import sys, attnwarp.cli; print([m for m in ('torch', 'numba', 'numpy', 'cv2', 'scipy') if"
        " m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_fit_and_render_do_what_they_say(data, tmp_path):
    out = tmp_path / "fit"
    done = call(
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
    )
    assert done.returncode == 0, done.stderr
    assert "splats.ply: " in done.stdout and "held-out PSNR" in done.stdout
    assert "loss" in done.stderr and "PSNR" in done.stderr  # plain lines, as there is no terminal
    history = [json.loads(line) for line in (out / "history.jsonl").read_text().splitlines()]
    assert [record["iteration"] for record in history] == [0, 20, 40, 60]
    assert history[-1]["psnr"] > history[0]["psnr"]
    assert json.loads((out / "settings.json").read_text())["iterations"] == 60
    splats = read_ply(out / "splats.ply")
    assert splats.kind == "2d"
    # 9 views: the first and the ninth are held out; picture and render side by side.
    assert sorted(p.name for p in (out / "held_out").iterdir()) == ["0.png", "8.png"]
    assert cv2.imread(str(out / "held_out" / "0.png")).shape == (32, 64, 3)

    pictures = tmp_path / "pictures"
    done = call(
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
    assert done.returncode == 0, done.stderr
    assert len(list(pictures.iterdir())) == 27
    image = cv2.imread(str(pictures / "3.png"))
    # One step of 8 bits: the rim of a splat may reach into the corner.
    np.testing.assert_allclose(image[0, 0].astype(int), [255, 102, 51], atol=1)
    depth = np.load(pictures / "3.depth.npy")
    assert depth.shape == (32, 32) and 2 < np.nanmedian(depth) < 4


def test_the_ply_opens_in_another_reader(data, tmp_path):
    from plyfile import PlyData

    done = in_process("fit", data, "--kind", "3dgs", "--out", tmp_path, "--iterations", 5)
    assert done.exit_code == 0, done.stderr
    vertex = PlyData.read(tmp_path / "splats.ply")["vertex"]
    assert len(vertex) == len(read_ply(tmp_path / "splats.ply"))
    assert {"x", "f_dc_0", "f_rest_44", "opacity", "scale_2", "rot_3"} <= {
        p.name for p in vertex.properties
    }


def test_the_number_of_threads_changes_no_bit(data, tmp_path):
    for count in (1, 3):
        done = in_process(
            "fit", data, "--out", tmp_path / str(count), "--iterations", 20, "--threads", count
        )
        assert done.exit_code == 0, done.stderr
    assert (tmp_path / "1" / "splats.ply").read_bytes() == (
        tmp_path / "3" / "splats.ply"
    ).read_bytes()


def start_and_wait_for_a_checkpoint(arguments, out):
    # A background job of a shell ignores the signal, and so would what it starts.
    listening = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen(
        [*ATTNWARP, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=listening,
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
        (signal.SIGKILL, -9),
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
    before = read_ply(out / "splats.ply")
    assert len(before) > 0
    done = in_process(*long, "--max-seconds", "0.5")
    assert done.exit_code == 0, done.stderr
    assert "iterations in" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fit", "nowhere", "--out", "{out}"], "nowhere: no such file or folder"),
        (["fit", "bear", "--out", "{out}"], "for a scene: attnwarp-eval scenes export bear DIR"),
        (
            ["fit", "scenes/bear.yaml", "--out", "{out}"],
            "for a scene: attnwarp-eval scenes export scenes/bear.yaml DIR",
        ),
        (
            ["fit", "{data}/none", "--out", "{out}"],
            "none: no such file or folder\n",
        ),  # no name of a scene: no hint
        (["fit", "{data}", "--out", "{out}", "--set", "lr_mean=1"], "did you mean 'lr_means'"),
        (["fit", "{data}", "--out", "{out}", "--set", "ssim"], "expected NAME=VALUE"),
        (["fit", "{data}", "--out", "{out}", "--set", "ssim=2"], "ssim: got 2"),
        (["fit", "{data}", "--out", "{out}", "--set", "kind=3d"], "--kind"),
        (["fit", "{data}", "--out", "{out}", "--hold-out", "1"], "leaves nothing to fit on"),
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


@pytest.mark.parametrize("command", ["fit", "render"])
def test_an_out_that_cannot_be_a_folder_ends_in_one_clear_line(data, tmp_path, command):
    taken = tmp_path / "taken"
    taken.write_text("not to be lost")
    write_ply(tmp_path / "m.ply", one_splat())
    first = [data] if command == "fit" else [tmp_path / "m.ply", data]
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
def test_a_disk_without_room_ends_in_one_clear_line(data, tmp_path, command):
    """No file may grow beyond 100 bytes, which to a writer is what a full disk is."""
    write_ply(tmp_path / "m.ply", one_splat())
    arguments = [data, "--iterations", 1] if command == "fit" else [tmp_path / "m.ply", data]
    # Once without the limit, lest it be numba's cache of compiled kernels that finds the disk full.
    assert in_process(command, *arguments, "--out", tmp_path / "warm").exit_code == 0
    done = subprocess.run(
        [
            *ATTNWARP,
            command,
            *map(str, arguments),
            "--threads",
            "1",
            "--out",
            str(tmp_path / "out"),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100)),
    )
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert (
        last.startswith(f"attnwarp: {tmp_path / 'out'}")
        and "File too large; check the path, the space" in last
    )
    assert not list((tmp_path / "out").iterdir())  # nor is half a file left


def test_render_needs_no_points(data, tmp_path):
    write_ply(tmp_path / "m.ply", one_splat())
    colmap = tmp_path / "colmap"
    colmap.mkdir()
    (colmap / "cameras.txt").write_text("1 PINHOLE 8 6 10 10 4 3\n")
    (colmap / "images.txt").write_text("1 1 0 0 0 0 0 3 1 front.png\n\n")
    for cloud in (b"", b"damaged"):
        (colmap / "points3D.txt").write_bytes(cloud)
        done = in_process("render", tmp_path / "m.ply", colmap, "--out", tmp_path / "out")
        assert done.exit_code == 0, done.stderr
        assert cv2.imread(str(tmp_path / "out" / "front.png")).shape == (6, 8, 3)
    # A transforms.json whose points were not copied along.
    alone = tmp_path / "transforms.json"
    alone.write_bytes((data / "transforms.json").read_bytes())
    assert "ply_file_path" in alone.read_text()
    done = in_process(
        "render", tmp_path / "m.ply", alone, "--out", tmp_path / "out", "--size", "16"
    )
    assert done.exit_code == 0, done.stderr


def test_views_of_the_same_file_name_do_not_overwrite_each_other(data, tmp_path):
    write_ply(tmp_path / "m.ply", one_splat())
    cameras = [
        Camera.look_at([3, 0, z], [0, 0, 0], width=8, height=8, fov_y=40, name=f"{side}/a.png")
        for z, side in ((0, "left"), (1, "right"))
    ]
    write_transforms(tmp_path / "c.json", Dataset(cameras, [None, None]))
    done = in_process(
        "render", tmp_path / "m.ply", tmp_path / "c.json", "--out", tmp_path / "out", "--size", "16"
    )
    assert done.exit_code == 0, done.stderr
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["0000-a.png", "0001-a.png"]
    assert cv2.imread(str(tmp_path / "out" / "0000-a.png")).shape == (16, 16, 3)
