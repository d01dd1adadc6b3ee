"""Commands beside pictures. Oracles: the shell's own words, and what a browser shows."""

import asyncio
import re
import shlex

import browser
import numpy as np
import pytest
import written_runs

from attnwarp_eval.document.write import markdown, page
from attnwarp_eval.report.build import build
from attnwarp_eval.study.record import PictureFile
from attnwarp_eval.study.shared.pictures import jpeg

STUDY = {
    "name": "hand-made",
    "scenes": ["one", "two"],
    "variants": {"it's good": {}, "other": {"set": {"pixel_centers": "integer"}}},
    "probes": {"warp": ["it's good", "other"]},
}


def report(root, seeds=(0,), views=("a",)):
    """A run whose warps of the view "a" have two pictures each, as the calibration's has."""
    cells = []
    for scene in STUDY["scenes"]:
        for probe, name in (("warp", "it's good"), ("warp", "other"), ("calibration", "exact")):
            data = written_runs.record([("a", 30.0, {})], spec={"views": list(views)})
            cell = written_runs.outcome(probe, scene, [name], data)
            pictures = [
                PictureFile("a", what, f"{scene}-{name}-{what}.jpg", "")
                for what in ("target", "endpoint-error")
            ]
            for picture in pictures:
                (root / picture.path).write_bytes(jpeg(np.zeros((8, 8, 3), np.float32)))
            cell.record.__dict__["pictures"] = tuple(pictures)
            cells.append(cell)
    results = written_runs.results({**STUDY, "seeds": list(seeds)}, cells)
    return build(results, root, timings=False)


def words(scene, variant, *more):
    return [
        *("attnwarp-eval", "inspect", ".", "--scene", scene, "--variant", variant, "--view", "a"),
        *more,
        *("--color", "endpoint error"),
    ]


def test_plain_text_has_one_command_a_scene(tmp_path):
    text = markdown(report(tmp_path))
    commands = [shlex.split(line) for line in text.splitlines() if line.startswith("attnwarp-eval")]
    assert commands == [words("one", "it's good"), words("two", "it's good")]


def test_a_run_of_several_seeds_names_the_cells_own(tmp_path):
    text = markdown(report(tmp_path, seeds=(0, 1)))
    line = next(line for line in text.splitlines() if line.startswith("attnwarp-eval"))
    assert shlex.split(line) == words("one", "it's good", "--seed", "0")


def test_views_that_are_no_targets_have_no_command(tmp_path):
    whole = report(tmp_path, views=("b",))
    assert "attnwarp-eval inspect" not in markdown(whole) + page(whole, tmp_path)


def test_a_page_has_a_command_beside_each_picture_of_a_variant(tmp_path):
    text = page(report(tmp_path), tmp_path)
    assert len(re.findall('class="command"', text)) == 4  # two variants of two scenes


def test_a_browser_shows_the_commands_of_the_pages_own_folder_and_of_the_picture_picked(tmp_path):
    if browser.executable() is None:
        pytest.skip("needs a Chromium (scripts/browser.sh)")
    root = tmp_path / "it's here"
    root.mkdir()
    (root / "report.html").write_text(page(report(root), root))

    async def look():
        async with browser.opened((root / "report.html").as_uri()) as tab:
            await tab.until("document.querySelectorAll('.command').length > 0")
            listed = "[...document.querySelectorAll('.all .command code')]"
            codes = await tab.run(f"{listed}.map((code) => code.textContent)")
            await tab.run("document.querySelector('.picker label:nth-child(2) select').value ="
                          " \"it's good: endpoint error\"")  # fmt: skip
            await tab.run("document.querySelector('.picker label:nth-child(2) select')"
                          ".dispatchEvent(new Event('change'))")  # fmt: skip
            return codes, await tab.run("document.querySelector('.picker .command code').innerHTML")

    codes, picked = asyncio.run(look())
    expected = [words(scene, name) for scene in STUDY["scenes"] for name in STUDY["variants"]]
    for own in expected:
        own[2] = str(root)
    assert [shlex.split(code) for code in codes] == expected
    assert "it" in picked and shlex.split(picked) == expected[0]
