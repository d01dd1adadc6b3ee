"""The page of an edit in a real browser. Oracle of the viewer: this library's renderer."""

import asyncio

import browser
import cv2
import numpy as np
import pytest
from tiny_scenes import splats as discs

from attnwarp import Camera
from attnwarp.command.page import show_edit
from attnwarp.fit import Views
from attnwarp.io import read_ply
from attnwarp.methods import by_view, preset
from attnwarp.methods.base import workdir_of
from attnwarp.render import render

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(browser.executable() is None, reason="needs a Chromium (scripts/browser.sh)"),
]  # fmt: skip

WIDTHS = {1400: 900, 390: 844}

DRAWN = "document.querySelector('#splats')?.dataset.drawn == 'whole'"

CUT = """[...document.querySelectorAll('main *')].filter(e => {
  const b = e.getBoundingClientRect();
  return b.width && (b.left < -0.5 || b.right > document.documentElement.clientWidth + 0.5
    || (e.children.length == 0 && e.scrollWidth > e.clientWidth + 1 && e.clientWidth));
}).map(e => e.outerHTML.slice(0, 80))"""

OVERLAPS = """(() => {
  const texts = [...document.querySelectorAll('h1, h2, p, b, figcaption, button, td, th, summary, .small')]
    .map(e => [e, e.getBoundingClientRect()]).filter(([e, b]) => b.width && b.height);
  const found = [];
  texts.forEach(([e, a], k) => texts.slice(k + 1).forEach(([f, b]) => {
    if (e.contains(f)) return;
    if (Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1
      && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1)
      found.push(e.textContent + ' | ' + f.textContent);
  }));
  return found;
})()"""

ENLARGE = """[...document.querySelectorAll('main figure > img:not(.turned)')].map(image => {
  const dialog = document.querySelector('#enlarged');
  image.click();
  const large = dialog.querySelector('img'), box = dialog.getBoundingClientRect();
  const right = dialog.open && large.src == image.src && large.width > image.width - 1
    && box.left >= 0 && box.right <= window.innerWidth && box.bottom <= window.innerHeight;
  dialog.click();
  return right && !dialog.open;
})"""


@pytest.fixture(scope="module")
def edit(scene, editor, tmp_path_factory):
    """Folder, cameras and page of an edit whose splats are opaque and of both colours and sizes."""
    folder = tmp_path_factory.mktemp("edit")
    _, cameras, images = scene
    model = discs()
    settings = preset("by_view", steps=2, iterations=3)
    by_view(model, cameras, images, editor, "make it red", settings, folder=folder)
    return (
        folder,
        cameras,
        show_edit(workdir_of(folder), model, Views(cameras, images), editor=editor),
    )


def opened(page, width):
    return browser.opened(page.as_uri(), (width, WIDTHS[width]))


async def sized(tab, width):
    await tab.send(
        "Emulation.setDeviceMetricsOverride", width=width, height=WIDTHS[width],
        deviceScaleFactor=1, mobile=width < 500,
    )  # fmt: skip
    await tab.until(DRAWN)


async def canvas(tab):
    """(H, W, 3) of the viewer as it is seen, and its middle in the window."""
    await tab.run("document.querySelector('#splats').scrollIntoView({block: 'center'})")
    await tab.until(DRAWN)
    await asyncio.sleep(0.5)
    left, top, w, h = await tab.run(
        "(b => [b.left, b.top, b.width, b.height].map(Math.round))"
        "(document.querySelector('#splats').getBoundingClientRect())"
    )
    return (await tab.picture())[top : top + h, left : left + w], (left + w / 2, top + h / 2)


@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_is_cut_no_text_overlaps_and_every_picture_enlarges(edit, width):
    async def person():
        async with opened(edit[2], width) as tab:
            await sized(tab, width)
            wide = await tab.run("document.documentElement.scrollWidth")
            await tab.run("document.querySelectorAll('details').forEach(d => { d.open = true; })")
            return wide, await tab.run(CUT), await tab.run(OVERLAPS), await tab.run(ENLARGE)

    wide, cut, overlaps, large = asyncio.run(person())
    assert wide <= width
    assert cut == [] and overlaps == []
    assert len(large) == 5 * 4 and all(large)


@pytest.mark.parametrize("width", WIDTHS)
def test_the_viewer_draws_what_the_renderer_draws_and_turns(edit, width):
    folder, cameras, page = edit

    async def person():
        async with opened(page, width) as tab:
            await sized(tab, width)
            first, (x, y) = await canvas(tab)
            await tab.mouse("mousePressed", x, y)
            for k in range(1, 6):
                await tab.send(
                    "Input.dispatchMouseEvent", type="mouseMoved", x=x + 12 * k, y=y,
                    button="left", buttons=1,
                )  # fmt: skip
                await asyncio.sleep(0.1)
            await tab.mouse("mouseReleased", x + 60, y)
            frames = int(await tab.run("document.querySelector('#splats').dataset.frames"))
            turned, _ = await canvas(tab)
            for kind, count in (
                ("mousePressed", 1),
                ("mouseReleased", 1),
                ("mousePressed", 2),
                ("mouseReleased", 2),
            ):
                await tab.send(
                    "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=count
                )
            await asyncio.sleep(1)
            return first, turned, (await canvas(tab))[0], frames

    first, turned, back, frames = asyncio.run(person())
    model = read_ply(folder / "edited.ply")

    def expected(camera):
        # The page keeps no view-dependent colour.
        pixels = render(model.with_sh_degree(0), camera.resize(512, 512)).color.clamp(0, 1).numpy()
        size = first.shape[1::-1]
        return 255 * cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)

    def error(picture, camera):
        return np.abs(picture.astype(float) - expected(camera)).mean()

    assert first.max() > 60, "the background alone"
    # A disc's fall-off is projected to first order: the rims of discs differ.
    assert error(first, cameras[0]) < 4
    # The picture of the angle of the drag, 60 px of half a turn, and not the one before.
    angle = -np.pi * 60 / first.shape[1]
    about = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    camera = cameras[0]
    middle = focus(cameras)
    place = middle + about @ (camera.position - middle)
    pose = np.eye(4)
    pose[:3, :3] = camera.rotation @ about.T
    pose[:3, 3] = -pose[:3, :3] @ place
    moved = Camera(camera.K, pose, camera.width, camera.height)
    assert error(turned, moved) < 4 < error(turned, camera)
    assert np.abs(back.astype(int) - first).max() <= 1
    assert frames >= 3


def focus(cameras):
    """The point nearest to the optical axes, by least squares on the lines' parameters."""
    a = [camera.position for camera in cameras]
    d = [camera.forward for camera in cameras]
    rows, right = [], []
    for place, axis in zip(a, d, strict=True):
        across = np.linalg.svd(axis[None])[2][1:]
        rows.append(across)
        right.append(across @ place)
    return np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]


def test_the_slider_uncovers_and_the_orbit_plays_and_is_dragged(edit):
    async def person():
        async with opened(edit[2], 1400) as tab:
            await sized(tab, 1400)
            await tab.run("document.querySelectorAll('.views button')[3].click()")
            same = await tab.run(
                "document.querySelectorAll('.slider img')[1].src == document.querySelector('#after-3').src"
            )
            await tab.run(
                "(r => { r.value = 0; r.dispatchEvent(new Event('input')); })(document.querySelector('.slider input'))"
            )
            cut = await tab.run(
                "getComputedStyle(document.querySelectorAll('.slider img')[1]).clipPath"
            )
            value = "Number(document.querySelector('.orbit input').value)"
            source = "document.querySelectorAll('.turned')[1].src"
            first = await tab.run(source)
            await tab.run("document.querySelector('.orbit button').click()")
            await tab.until(f"{value} >= 3")
            played = await tab.run(source)
            await tab.run("document.querySelector('.orbit button').click()")
            stopped = await tab.run(value)
            await tab.run("document.querySelector('.orbit').scrollIntoView({block: 'center'})")
            left, top, w = await tab.run(
                "(b => [b.left, b.top, b.width])(document.querySelector('.turned').getBoundingClientRect())"
            )
            await tab.mouse("mousePressed", left + 10, top + 50)
            await tab.mouse("mouseMoved", left + 10 + w / 4, top + 50)
            await tab.mouse("mouseReleased", left + 10 + w / 4, top + 50)
            return same, cut, first != played, stopped, await tab.run(value)

    same, cut, moved, stopped, dragged = asyncio.run(person())
    assert same and cut == "inset(0px 0px 0px 0%)" and moved
    assert (dragged - stopped) % 36 == 9  # a quarter of the picture's width is one of the turn
