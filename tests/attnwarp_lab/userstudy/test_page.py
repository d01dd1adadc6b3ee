"""Oracles: the run's own files, and the page as an HTML parser reads it."""

import base64
import io
import json
from html.parser import HTMLParser

import numpy as np
import pytest
import yaml
from edited_run import write_run
from PIL import Image
from typer.testing import CliRunner

from attnwarp_eval.cli.main import app
from attnwarp_eval.document.write import LARGEST
from attnwarp_eval.study import Store, load_study
from attnwarp_eval.study.run import expected, plan
from attnwarp_lab.userstudy.draw import SCRAMBLED


class Reader(HTMLParser):
    """Reader of what a browser would load from elsewhere, and of the page's data."""

    def __init__(self):
        super().__init__()
        self.loaded, self.data, self.inside = [], "", False

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.inside = values.get("id") == "study"
        self.loaded += [v for k, v in attributes if k in ("src", "href") and v]

    def handle_data(self, data):
        if self.inside:
            self.data += data
            self.inside = False


def build(*arguments):
    return CliRunner().invoke(app, ["userstudy", "build", *map(str, arguments)])


def read(path):
    reader = Reader()
    reader.feed(path.read_text())
    return reader, json.loads(reader.data)


def color(data):
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data.partition(",")[2])))).mean((0, 1))


def test_the_page_is_not_written_over_a_file_of_a_run(run):
    before = (run.root / "study.json").read_bytes()
    done = build(run.root, "--out", run.root / "study.json")
    assert done.exit_code == 2 and f"is a file of the run {run.root}" in done.stderr
    assert (run.root / "study.json").read_bytes() == before


def test_the_page_loads_nothing_and_shows_each_method_its_own_pictures(run, tmp_path):
    done = build(run.root, "--out", tmp_path / "a.html", "--title", "</script><b>Which?")
    assert done.exit_code == 0, done.output
    reader, study = read(tmp_path / "a.html")
    assert reader.loaded == [] and "http" not in (tmp_path / "a.html").read_text()
    assert study["title"] == "</script><b>Which?"
    assert len(study["items"]) == 4  # two edits, two seeds
    for item in study["items"]:
        assert item["instruction"] == f"paint it {item['edit']}"
        for name, rgb in run.colors.items():
            for picture in item["sides"][name]:
                assert color(study["pictures"][picture]) == pytest.approx(rgb, abs=4)
        assert color(study["pictures"][item["before"][0]]) == pytest.approx([128] * 3, abs=4)
    used = {c[0] for plan in study["plans"] for c in plan if SCRAMBLED in c}
    assert used and all(SCRAMBLED in study["items"][number]["sides"] for number in used)


def test_equal_arguments_give_equal_bytes_and_another_seed_another_study(run, tmp_path):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        assert build(run.root, "--out", tmp_path / name, "--seed", seed).exit_code == 0
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert read(tmp_path / "a")[1]["study"] != read(tmp_path / "c")[1]["study"]


def test_methods_and_questions_can_be_chosen(run, tmp_path):
    done = build(run.root, "--out", tmp_path / "a", "--method", "alone", "--method", "third", "--questions", "quality",
                 "--choices", 3, "--checks", 0, "--plans", 4)  # fmt: skip
    assert done.exit_code == 0, done.output
    _, study = read(tmp_path / "a")
    assert list(study["questions"]) == ["quality"]
    assert [len(plan) for plan in study["plans"]] == [3] * 4
    assert {name for plan in study["plans"] for row in plan for name in row[2:]} == {
        "alone",
        "third",
    }


def test_a_page_of_many_pictures_stays_within_its_size(run, tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    monkeypatch.setattr(
        "attnwarp_lab.userstudy.page.of_views", lambda item, files: [noise(rng) for _ in files]
    )
    assert build(run.root, "--out", tmp_path / "a").exit_code == 0
    _, study = read(tmp_path / "a")
    total = sum(len(base64.b64decode(v.partition(",")[2])) for v in study["pictures"].values())
    assert 0.1 * LARGEST < total <= LARGEST


def noise(rng):
    buffer = io.BytesIO()
    Image.fromarray(rng.integers(0, 255, (512, 512, 3), np.uint8)).save(buffer, "JPEG", quality=95)
    return buffer.getvalue()


def test_scrambling_moves_the_parts_and_keeps_them():
    from attnwarp_lab.userstudy.material import TILES, scrambled

    rng = np.random.default_rng(0)
    colors = rng.integers(0, 255, (TILES, TILES, 3), np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(np.kron(colors, np.ones((16, 16, 1), np.uint8))).save(buffer, "PNG")
    pixels = np.asarray(Image.open(io.BytesIO(scrambled(buffer.getvalue(), 0))))
    after = pixels.reshape(TILES, 16, TILES, 16, 3).mean((1, 3))
    assert (np.abs(after - colors).max(-1) > 20).mean() > 0.7
    nearest = np.abs(after[:, :, None, None] - colors).sum(-1).reshape(-1, TILES * TILES).argmin(1)
    assert sorted(nearest) == list(range(TILES * TILES))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--method", "alone"], "no edited scene has pictures of two methods"),
        (["--method", "magic"], "--method: got 'magic'"),
        (["--questions", "beauty"], "--questions: got 'beauty'"),
        (["--questions", "quality,quality"], "expected different ones"),
    ],
)
def test_what_cannot_be_built_is_one_line(run, tmp_path, arguments, message):
    done = build(run.root, "--out", tmp_path / "a", *arguments)
    assert done.exit_code == 2 and message in done.stderr and done.stderr.count("\n") == 1
    assert not (tmp_path / "a").exists()


def test_two_names_of_the_same_settings_are_both_on_the_page(tmp_path):
    run = write_run(tmp_path)
    path = tmp_path / "people.yaml"
    study = yaml.safe_load(path.read_text())
    study["variants"]["again"] = study["variants"]["alone"]
    del study["variants"]["warped"]
    names = study["probes"]["editing"] = study["pictures"]["variants"] = ["alone", "again", "third"]
    path.write_text(yaml.safe_dump(study, sort_keys=False))
    store = Store(run.root)
    store.write_study(expected(plan(load_study(str(path)), store)))
    done = build(run.root, "--out", tmp_path / "a")
    assert done.exit_code == 0, done.output
    for item in read(tmp_path / "a")[1]["items"]:
        assert set(names) <= set(item["sides"])


def pixels_of(address):
    picture = Image.open(io.BytesIO(base64.b64decode(address.split(",")[1])))
    return np.asarray(picture.convert("RGB"))


def test_people_see_pictures_of_256_px_and_more(run, tmp_path):
    """The run's are of 64 px."""
    assert build(run.root, "--out", tmp_path / "page.html").exit_code == 0
    _, study = read(tmp_path / "page.html")
    sizes = {pixels_of(address).shape for address in study["pictures"].values()}
    assert sizes == {(256, 256, 3)}


def captured(folder, views=20, size=320):
    """The folder of a run on a capture: a colour for each variant."""
    colors = {"alone": (200, 40, 40), "warped, twice": (40, 40, 200)}
    folders = {"originals/garden": (90, 90, 90)} | {
        f"made/{k}/renders": color for k, color in enumerate(colors.values())
    }
    for part, color in folders.items():
        (folder / part).mkdir(parents=True)
        for view in range(views):
            picture = Image.new("RGB", (size, size // 2), color)
            picture.save(folder / part / f"view-{view:04d}.png")
    cells = [
        {"id": str(k), "scene": "garden", "edit": "snow", "seed": 0,
         "variants": [name], "folder": f"made/{k}"}
        for k, name in enumerate(colors)
    ]  # fmt: skip
    garden = {"sha256": "0", "views": ["v"] * views, "originals": "originals/garden",
              "edits": {"snow": "make it snow"}}  # fmt: skip
    (folder / "results.json").write_text(
        json.dumps({"captures": {"garden": garden}, "cells": cells})
    )
    return colors


def test_a_run_on_a_capture_is_shown_with_eight_of_its_views(tmp_path):
    colors = captured(tmp_path / "garden")
    done = build(tmp_path / "garden", "--out", tmp_path / "page.html")
    assert done.exit_code == 0, done.output
    _, study = read(tmp_path / "page.html")
    (item,) = study["items"]
    assert (item["scene"], item["instruction"]) == ("garden", "make it snow")
    for name, color in (*colors.items(), (None, (90, 90, 90))):
        names = item["before"] if name is None else item["sides"][name]
        assert len(names) == 8
        for picture in names:
            pixels = pixels_of(study["pictures"][picture])
            assert pixels.shape == (160, 320, 3) and np.abs(pixels - np.array(color)).max() < 8


def test_a_damaged_file_of_a_run_on_a_capture_is_one_line(tmp_path):
    captured(tmp_path / "garden", views=1)
    (tmp_path / "garden" / "results.json").write_text("{}")
    done = build(tmp_path / "garden", "--out", tmp_path / "page.html")
    assert done.exit_code == 2 and "results.json: damaged" in done.output
