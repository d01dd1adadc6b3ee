"""The page in a real browser. Oracle: what was pressed, against the file that the browser saved."""

import asyncio
import json

import browser
import pytest
from edited_run import write_run
from typer.testing import CliRunner

from attnwarp_eval.cli.main import app

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(browser.executable() is None, reason="needs a Chromium (scripts/browser.sh)"),
]  # fmt: skip

LEFT, RIGHT, BACK, PAUSE = ("ArrowLeft", 37), ("ArrowRight", 39), ("Backspace", 8), ("p", 80)


@pytest.fixture
def page(run, tmp_path):
    return built(run.root, tmp_path)


def built(root, folder):
    done = CliRunner().invoke(app, ["userstudy", "build", str(root), "--out", str(folder / "page.html"),
                                    "--choices", "18", "--checks", "2"])  # fmt: skip
    assert done.exit_code == 0, done.output
    return (folder / "page.html").as_uri() + "?plan=5"


async def begin(tab):
    await tab.until(f"document.querySelector('#start') && {shows('start')}")
    await tab.press("Enter", 13)
    await tab.until(shows("trial"))
    await asyncio.sleep(0.3)  # after a reload, too, a pair rests before it takes a choice


def shows(section):
    return f"!document.querySelector('#{section}').hidden"


async def place(tab):
    return int((await tab.run("document.querySelector('#place').textContent")).split()[0])


async def answer(tab, side):
    """Choose, and wait until the next pair or the end is there and takes a choice."""
    number = await place(tab)
    await tab.press(*(LEFT if side == "left" else RIGHT))
    await tab.until(
        f"document.querySelector('#place').textContent != '{number} of 20' || {shows('end')}"
    )
    await asyncio.sleep(0.3)


async def plan_of(tab):
    return await tab.run("JSON.parse(document.querySelector('#study').textContent).plans[5]")


async def saved(tab, folder):
    await tab.send("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder))
    await tab.run("document.querySelector('#end .save').click()")
    for _ in range(100):
        await asyncio.sleep(0.1)
        files = list(folder.glob("answers-*.json"))
        if files and files[0].stat().st_size:
            return files[0]
    raise AssertionError("nothing was saved")


def test_twenty_answers_with_a_reload_in_the_middle_are_all_saved(page, tmp_path):
    sides = ["left" if k % 3 else "right" for k in range(20)]

    async def person():
        async with browser.opened(page) as tab:
            await begin(tab)
            plan = await plan_of(tab)
            for k, side in enumerate(sides[:11]):
                assert await place(tab) == k + 1
                await answer(tab, side)
            await tab.send("Page.reload")
            await begin(tab)
            assert await place(tab) == 12
            for side in sides[11:]:
                await answer(tab, side)
            assert await tab.run(shows("end"))
            return plan, json.loads((await saved(tab, tmp_path)).read_text())

    plan, data = asyncio.run(person())
    assert [c["chosen"] for c in data["choices"]] == sides
    assert [[c["question"], c["left"], c["right"]] for c in data["choices"]] == [
        row[1:] for row in plan
    ]
    assert data["plan"] == 5 and data["planned"] == 20
    # Each answer but that after the reload took at least the pause between two.
    assert sorted(c["seconds"] for c in data["choices"])[1] > 0.2
    path = next(tmp_path.glob("answers-*.json"))
    done = CliRunner().invoke(app, ["userstudy", "score", str(path)])
    assert done.exit_code in (0, 3), done.output  # checks fall where they fall


def test_no_answer_is_lost_where_the_browser_is_killed_once_the_next_pair_is_shown(page, tmp_path):
    async def person():
        for number in (1, 2):
            async with browser.opened(page, profile=tmp_path / "profile") as tab:
                await begin(tab)
                assert await place(tab) == number
                await answer(tab, "left")

    asyncio.run(person())


def test_the_last_choice_can_be_taken_back_and_a_pause_stops_the_clock(page, tmp_path):
    async def person():
        async with browser.opened(page) as tab:
            await begin(tab)
            await answer(tab, "left")
            await answer(tab, "left")
            await tab.press(*BACK)
            assert await place(tab) == 2
            await tab.press(*PAUSE)
            await tab.until(shows("paused"))
            assert "1 of 20" in await tab.run("document.querySelector('#done').textContent")
            await tab.press(*LEFT)  # does nothing here
            await tab.run("document.querySelector('#paused .save').focus()")
            await tab.press("Enter", 13)  # saves, and does not go on
            await tab.until("document.querySelector('#saved').textContent.startsWith('Saved')")
            assert await tab.run(shows("paused"))
            await asyncio.sleep(4)
            await tab.press(*PAUSE)
            await tab.until(shows("trial"))
            await asyncio.sleep(0.4)
            for _ in range(19):
                await answer(tab, "right")
            return json.loads((await saved(tab, tmp_path)).read_text())

    choices = asyncio.run(person())["choices"]
    assert [c["chosen"] for c in choices] == ["left"] + ["right"] * 19
    assert choices[1]["seconds"] < 3


@pytest.mark.parametrize("dark", [False, True])
def test_it_fits_a_phone_in_both_schemes_and_a_tap_chooses(page, dark):
    async def person():
        async with browser.opened(page, (390, 844)) as tab:
            await tab.send(
                "Emulation.setDeviceMetricsOverride",
                width=390,
                height=844,
                deviceScaleFactor=1,
                mobile=True,
            )
            scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
            await tab.send("Emulation.setEmulatedMedia", features=[scheme])
            await begin(tab)
            wide = await tab.run("document.documentElement.scrollWidth")
            box = await tab.run("(b => [b.left + b.width / 2, b.top + b.height / 2, b.bottom, b.width])"
                                "(document.querySelector('#right').getBoundingClientRect())")  # fmt: skip
            ground = (await tab.picture())[2, 2].mean()
            await tab.click(box[0], box[1])
            await tab.until("document.querySelector('#place').textContent == '2 of 20'")
            return wide, box, ground

    wide, box, ground = asyncio.run(person())
    assert wide <= 390 and box[2] <= 844 and box[3] > 150
    assert (ground < 60) == dark


def test_more_than_three_views_turn_together(tmp_path):
    page = built(write_run(tmp_path, views=4, seeds=(0,)).root, tmp_path)

    async def person():
        async with browser.opened(page) as tab:
            await begin(tab)
            assert await tab.run("document.querySelectorAll('#left img').length") == 1
            seen = set()
            for _ in range(40):
                seen.add(await tab.run("document.querySelector('#angle').value"))
                await asyncio.sleep(0.1)
            await tab.run("document.querySelector('#play').click()")
            before = await tab.run("document.querySelector('#angle').value")
            await asyncio.sleep(1)
            return seen, before == await tab.run("document.querySelector('#angle').value")

    seen, stands = asyncio.run(person())
    assert seen == {"0", "1", "2", "3"} and stands


def test_what_a_person_has_chosen_is_not_shown_to_the_next_one(page, tmp_path):
    async def person():
        async with browser.opened(page.replace("plan=5", "plan=0")) as tab:
            await begin(tab)
            for _ in range(20):
                await answer(tab, "left")
            first = json.loads((await saved(tab, tmp_path)).read_text())["person"]
            await tab.run("document.querySelector('#again').click()")
            await tab.until(shows("start"))
            await begin(tab)
            number = await place(tab)
            return first, number, json.loads((await saved(tab, tmp_path / "next")).read_text())

    first, number, second = asyncio.run(person())
    assert number == 1 and second["choices"] == [] and second["person"] != first
