"""The report of a run in a real browser, on a wide and on a narrow window."""

import asyncio

import browser
import pytest

from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Picture, Report, Section
from attnwarp_eval.document.write import write_files
from attnwarp_eval.report import write_report
from attnwarp_eval.statistics.intervals import interval
from attnwarp_eval.study import Store, load_study
from attnwarp_eval.study.run import execute, plan

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(browser.executable() is None, reason="needs a Chromium (scripts/browser.sh)"),
]  # fmt: skip

WIDTHS = {1400: 900, 390: 844}

CUT = """[...document.querySelectorAll('body *')].filter(e => {
  if (e.closest('.scroll > *, nav > *, .plots > *, .slider > *, dialog')) return false;
  const b = e.getBoundingClientRect();
  return b.width && b.height && (b.left < -0.5 || b.right > document.documentElement.clientWidth + 0.5
    || (e.children.length == 0 && e.clientWidth && e.scrollWidth > e.clientWidth + 1));
}).map(e => e.outerHTML.slice(0, 90))"""
"""Elements that leave the window, but for what lies in something that scrolls."""

OVERLAPS = """(() => {
  const found = [];
  const compare = (parts) => {
    const boxes = parts.map(e => [e, e.getBoundingClientRect()]).filter(([, b]) => b.width && b.height)
      .sort(([, a], [, b]) => a.top - b.top);
    boxes.forEach(([e, a], k) => {
      for (const [f, b] of boxes.slice(k + 1)) {
        if (b.top > a.bottom - 2) break;
        if (!e.contains(f) && !f.contains(e) && Math.min(a.right, b.right) - Math.max(a.left, b.left) > 2
          && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 2)
          found.push([e.id || e.textContent.trim().slice(0, 40), f.id || f.textContent.trim().slice(0, 40)]);
      }
    });
  };
  compare([...document.querySelectorAll('h1, h2, h3, p, li, caption, figcaption, summary')]);
  document.querySelectorAll('table').forEach(t => compare([...t.querySelectorAll('tr > *')]));
  document.querySelectorAll('.plots svg').forEach(s => compare([...s.querySelectorAll('g[id*="text_"]')]));
  return found;
})()"""
"""Pairs of texts that lie over each other: on the page, in a table, in a chart."""

ENLARGE = """[...document.querySelectorAll('.grid img, .gallery figure:not(.slider) > img, .plots > svg')].map(picture => {
  const dialog = document.querySelector('#enlarged');
  picture.dispatchEvent(new MouseEvent('click', {bubbles: true}));
  const large = dialog.querySelector('img'), box = dialog.getBoundingClientRect();
  const right = dialog.open && large.getAttribute('src').startsWith('data:image')
    && box.left >= 0 && box.right <= window.innerWidth && box.bottom <= window.innerHeight;
  dialog.click();
  return right && !dialog.open;
})"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory, coarse_textures):
    """Report of the demo's study on one scene, small: with pictures, an edit, charts, wide tables."""
    folder = tmp_path_factory.mktemp("run")
    store = Store(folder)
    study = load_study("quick", scenes=["bear"], size=64, timing_rounds=3)
    assert execute(plan(study, store), store).complete
    write_report(store)
    return folder / "report.html"


FRONT = """
5k splats 27.1 0.487; 15k splats 30.1 0.342; corrected 37.2 0.287; 120k splats 57.4 0.259; 3DGS, peak 34.3 0.325;
bounds only 31.5 0.896; paper 33.2 0.91; released 61.3 0.853; corrected, bilinear mask 30.2 0.343;
corrected, depth blended in z 36.7 0.32
"""
"""Points of the demo at 512 px, two of them moved onto others: name, milliseconds, error."""


@pytest.fixture(scope="module")
def crowded(tmp_path_factory):
    """A page of two fronts whose points lie close together."""
    folder = tmp_path_factory.mktemp("crowded")
    demo = [point.strip().rsplit(" ", 2) for point in FRONT.split(";")]
    close = [(f"a rather long name {k}", 1 + k % 4 / 50, 1 + k / 90) for k in range(12)]
    section = Section("Fronts")
    for index, points in enumerate((demo, close)):
        path = folder / f"front-{index}.svg"
        intervals = {
            name: tuple(interval({"a": [0.8 * float(v)], "b": [1.2 * float(v)]}) for v in values)
            for name, *values in points
        }
        with charts.drawing(path) as (axes,):
            charts.cost_front(axes, intervals, x="milliseconds", y="error", title="Front")
        section.figures.append(Picture(path.name, "Front"))
    # More titles than one line of 1400 px holds.
    titled = [Section(f"In detail: where the labels of parts arrive, {k}") for k in range(9)]
    write_files(Report("Crowded", [], [section, *titled]), folder, "report")
    return folder / "report.html"


def test_the_bar_of_a_wide_page_shows_every_section(crowded):
    async def person():
        async with browser.opened(crowded.as_uri(), (1400, 900)) as tab:
            await tab.until("document.readyState == 'complete'")
            ends = (
                "[...document.querySelectorAll('nav a')].map(a => a.getBoundingClientRect().right)"
            )
            return await tab.run(ends)

    ends = asyncio.run(person())
    assert len(ends) == 10 and max(ends) <= 1400


@pytest.mark.parametrize("width", WIDTHS)
def test_no_name_at_a_crowded_front_lies_over_another(crowded, width):
    async def person():
        async with browser.opened(crowded.as_uri(), (width, WIDTHS[width])) as tab:
            await tab.until("document.querySelectorAll('.plots svg').length == 2")
            names = "document.querySelectorAll('.plots svg g[id*=\"text_\"]').length"
            return await tab.run(names), await tab.run(OVERLAPS)

    names, overlaps = asyncio.run(person())
    assert names > 22
    assert overlaps == []


@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_is_cut_no_label_overlaps_and_every_picture_enlarges(pages, width):
    async def person():
        async with browser.opened(pages.as_uri(), (width, WIDTHS[width])) as tab:
            await tab.send(
                "Emulation.setDeviceMetricsOverride", width=width, height=WIDTHS[width],
                deviceScaleFactor=1, mobile=width < 500,
            )  # fmt: skip
            await tab.until(
                "document.readyState == 'complete' && !!document.querySelector('#answer')"
            )
            first = await tab.run(
                "[...document.querySelectorAll('.grid')].map(g => g.getBoundingClientRect().bottom)"
            )
            await tab.run("document.querySelectorAll('details').forEach(d => { d.open = true; })")
            return (
                first,
                await tab.run("document.documentElement.scrollWidth"),
                await tab.run(CUT),
                await tab.run(OVERLAPS),
                await tab.run(ENLARGE),
            )

    first, wide, cut, overlaps, large = asyncio.run(person())
    assert len(first) == 2
    if width == 1400:
        assert max(first) <= WIDTHS[width] + 40  # the answer's pictures are on the first screen
    assert wide <= width
    assert cut == []
    assert overlaps == []
    assert len(large) > 50 and all(large)
