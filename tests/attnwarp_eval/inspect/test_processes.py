"""The command as its user has it: a real window, a real browser, a machine without OpenGL, and a large scene."""

import asyncio
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import browser
import numpy as np
import pytest
import torch

from attnwarp import Camera, Gaussians
from attnwarp.io import Dataset, write_ply, write_transforms

pytestmark = pytest.mark.slow

COMMAND = [sys.executable, "-m", "attnwarp_eval", "inspect"]


def environment(**changes):
    hidden = {"DISPLAY", "WAYLAND_DISPLAY"}
    return {**{k: v for k, v in os.environ.items() if k not in hidden}, **changes}


@pytest.fixture
def display():
    """The name of a screen of a virtual X server."""
    if shutil.which("Xvfb") is None:
        pytest.skip("needs Xvfb (Debian: xvfb)")
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "1920x1200x24", "-nolisten", "tcp"],
        pass_fds=[write], stderr=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(write)
    with os.fdopen(read) as stream:
        name = f":{stream.readline().strip()}"
    yield name
    server.terminate()
    server.wait(30)


class Screen:
    """Tools of a person: a picture of the screen, a keyboard and a mouse."""

    def __init__(self, name):
        from Xlib.display import Display

        self.display = Display(name)
        self.root = self.display.screen().root

    def picture(self):
        from Xlib import X

        size = self.root.get_geometry()
        data = self.root.get_image(0, 0, size.width, size.height, X.ZPixmap, 0xFFFFFFFF).data
        return np.frombuffer(data, np.uint8).reshape(size.height, size.width, 4)[..., :3].copy()

    def settled(self, different=None, seconds=600):
        """The picture once it no longer changes, and differs from another one."""
        end, last = time.monotonic() + seconds, self.picture()
        while time.monotonic() < end:
            time.sleep(1.0)
            now = self.picture()
            if (now == last).all() and (different is None or (now != different).any()):
                return now
            last = now
        raise AssertionError("the screen did not change")

    def press(self, key, shift=False):
        from Xlib import XK, X
        from Xlib.ext import xtest

        codes = [self.display.keysym_to_keycode(XK.string_to_keysym(key))]
        if shift:
            codes.insert(0, self.display.keysym_to_keycode(XK.string_to_keysym("Shift_L")))
        for code in codes:
            xtest.fake_input(self.display, X.KeyPress, code)
        for code in reversed(codes):
            xtest.fake_input(self.display, X.KeyRelease, code)
        self.display.sync()

    def move(self, x, y):
        from Xlib import X
        from Xlib.ext import xtest

        xtest.fake_input(self.display, X.MotionNotify, x=x, y=y)
        self.display.sync()

    def click(self, x, y):
        from Xlib import X
        from Xlib.ext import xtest

        self.move(x, y)
        for kind in (X.ButtonPress, X.ButtonRelease):
            xtest.fake_input(self.display, kind, 1)
            self.display.sync()
            time.sleep(0.2)


def test_a_real_window_follows_its_keys_and_closes(display, tmp_path):
    process = subprocess.Popen(
        [*COMMAND, "spheres", "--size", "32", "--view", "yaw060"],
        env=environment(DISPLAY=display), stderr=subprocess.PIPE, text=True, cwd=tmp_path,
    )  # fmt: skip
    screen = Screen(display)
    try:
        empty = screen.picture()
        before = screen.settled(different=empty)
        screen.move(550, 300)
        for key, shift in (("question", True), ("question", True), ("n", False), ("v", False),
                           ("c", False), ("l", False), ("l", False), ("d", False), ("2", False)):  # fmt: skip
            screen.press(key, shift)
            before = screen.settled(different=before)
        screen.click(550, 450)
        screen.settled(different=before)
        screen.press("q")
        _, errors = process.communicate(timeout=300)
        assert process.returncode == 0 and not errors
    finally:
        process.kill()
        screen.display.close()


def children(pid):
    listed = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True
    )
    return [int(word) for word in listed.stdout.split()]


@pytest.fixture
def served(tmp_path):
    """A served window: its process and its address."""
    if browser.executable() is None:
        pytest.skip("needs a Chromium (scripts/browser.sh)")
    process = subprocess.Popen(
        [*COMMAND, "spheres", "--size", "32", "--view", "yaw060", "--web"],
        env=environment(), stdout=subprocess.PIPE, text=True, cwd=tmp_path,
    )  # fmt: skip
    url = ""
    while not url.startswith("http"):
        url = process.stdout.readline()
        assert url, "the server ended"
    yield process, url.strip()
    process.kill()
    process.wait()
    process.stdout.close()


def listening(port):
    """Local addresses, in hexadecimal, at which a port is open."""
    rows = [line.split()[1:4] for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return [own.split(":")[0] for own, _, state in rows
            if state == "0A" and int(own.split(":")[1], 16) == port]  # fmt: skip


def test_a_browser_shows_it_and_closing_the_page_leaves_no_process(served):
    process, url = served
    port = int(re.search(r":(\d+)/", url)[1])
    assert listening(port) == ["0100007F"]  # 127.0.0.1 alone
    asyncio.run(_browse(url))
    assert process.wait(300) == 0
    assert not listening(port)


async def _browse(url):
    loaded = "document.querySelector('img')?.src?.length > 10"
    async with browser.opened(url.split("?")[0]) as tab:
        await asyncio.sleep(5)
        assert not await tab.run(loaded)  # without the secret there is no picture
    async with browser.opened(url) as tab:
        await tab.until(loaded)
        await asyncio.sleep(2)
        before = await tab.picture()
        source = await tab.run("document.querySelector('img').src")
        await tab.run("document.querySelector('.slider-target [role=slider]').focus()")
        await tab.press("ArrowRight", 39)
        await tab.until(f"document.querySelector('img').src != '{source}'")
        assert "view: yaw075" in await tab.run("document.body.innerText")
        after = await tab.picture()
        assert (before[:, 340:] != after[:, 340:]).mean() > 0.02
        for x, y in ((690, 190), (800, 190), (790, 350)):
            await tab.click(x, y)
            await asyncio.sleep(3)
            if await tab.run("document.querySelector('pre').innerText.length > 20"):
                break
        await tab.until("document.querySelector('pre').innerText.includes('depth, truth')")


def test_ctrl_c_ends_the_server(served):
    process, _ = served
    process.send_signal(signal.SIGINT)
    assert process.wait(300) in (0, 130)
    assert not children(process.pid)


def test_a_page_to_share_draws_itself_without_a_network(tmp_path):
    if browser.executable() is None:
        pytest.skip("needs a Chromium (scripts/browser.sh)")
    page = tmp_path / "a.html"
    subprocess.run([*COMMAND, "spheres", "--size", "32", "--view", "yaw060", "--pixel", "16,20",
                    "--export", page], env=environment(), check=True)  # fmt: skip
    assert not re.search(r"<(script|link)[^>]+(src|href)=.https?:", page.read_text())

    async def look():
        async with browser.opened(page.as_uri()) as tab:
            await tab.until("document.querySelector('canvas') != null")
            for _ in range(60):
                await asyncio.sleep(1)
                picture = await tab.picture()
                green = (picture[..., 1] > picture[..., 0] + 40).mean()
                if green > 0.02:  # the mask's "visible, accepted"
                    return green, await tab.run("[document.title, document.body.innerText]")
        return 0.0, None

    green, texts = asyncio.run(look())
    assert green > 0.02
    title, text = texts
    assert title == "spheres, corrected, source -> yaw060; colours: mask"
    assert all(words in text for words in (title, "\u25a0 visible, accepted", "hidden, accepted"))


def test_without_opengl_the_error_names_the_remedy_and_files_are_written(tmp_path):
    # A driver list that names no driver: neither EGL nor a display, and no OSMesa on test machines.
    hidden = environment(__EGL_VENDOR_LIBRARY_FILENAMES=str(tmp_path / "none"))
    small = [*COMMAND, "spheres", "--size", "32"]
    done = subprocess.run(
        [*small, "--screenshot", tmp_path / "a.png"], env=hidden, capture_output=True, text=True
    )
    from attnwarp_eval.inspect.gl import OSMESA, _loads

    if any(_loads(name) for name in OSMESA):
        assert done.returncode == 0
        return
    assert done.returncode == 2 and "libegl1" in done.stderr and done.stderr.count("\n") == 1
    done = subprocess.run([*small, "--export", tmp_path / "a.glb"], env=hidden)
    assert done.returncode == 0 and (tmp_path / "a.glb").stat().st_size > 10_000


def test_the_librarys_command_becomes_the_instruments(folders, tmp_path):
    out = tmp_path / "a.glb"
    done = subprocess.run(
        [sys.executable, "-m", "attnwarp", "inspect", folders / "scene.ply", folders,
         "--pixel", "16,16", "--export", out],
        env=environment(), capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "pixel (16, 16)" in done.stdout and out.stat().st_size > 1000
    done = subprocess.run(
        [sys.executable, "-m", "attnwarp", "inspect", folders / "no.ply", folders],
        env=environment(), capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 2 and done.stderr.startswith("attnwarp: ")


def test_the_first_picture_of_a_large_scene_fits_in_memory(tmp_path):
    """A hollow ball of 200,000 discs, from inside: 1.0 GiB (reports/inspect at commit 29727b66)."""
    random = torch.Generator().manual_seed(0)
    away = torch.nn.functional.normalize(torch.randn((200_000, 3), generator=random), dim=1)
    # The rotation from the z axis to the normal; discs whose areas add up to 1.5 of the ball's.
    turn = torch.stack([1 + away[:, 2], -away[:, 1], away[:, 0], torch.zeros(len(away))], dim=1)
    model = Gaussians(
        "2d", 3 * away, torch.nn.functional.normalize(turn, dim=1),
        torch.full((len(away), 2), 0.02), torch.full((len(away),), 0.95),
        Gaussians.sh_from_rgb(torch.rand((len(away), 3), generator=random)),
    )  # fmt: skip
    cameras = [
        Camera.look_at((x, 0, 0), (x, 3, 0.2), name=name, width=592, height=592, fov_y=60)
        for x, name in ((0.0, "a.png"), (0.3, "b.png"))
    ]
    write_ply(tmp_path / "scene.ply", model)
    write_transforms(tmp_path / "transforms.json", Dataset(cameras, [None, None]))
    # Linux counts what a process held when it started another one as the other one's: a small one
    # starts the command, and says the peak of its child.
    peak = """
import resource, subprocess, sys
assert subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL) == 0
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""
    words = [*COMMAND, tmp_path / "scene.ply", "--data", tmp_path, "--size", "592", "--splats"]
    done = subprocess.run(
        [sys.executable, "-c", peak, *words, "--screenshot", tmp_path / "first.png"],
        env=environment(), stdout=subprocess.PIPE, check=True,
    )  # fmt: skip
    unit = 2**30 if sys.platform == "darwin" else 2**20  # macOS counts bytes, Linux KiB
    assert int(done.stdout) / unit < 2
