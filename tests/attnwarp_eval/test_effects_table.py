"""The table of all scenes: what it says, that it goes on where it was, and pictures that show a difference."""

import functools
import json

import cv2
import numpy as np
import pytest
from effect_scenes import FLOOR, SKY, SUN, make
from typer.testing import CliRunner

from attnwarp_eval import effects, effects_table
from attnwarp_eval.cli import app
from attnwarp_eval.effects_table import Settings, collect, plan_words, said_by, side_by_side
from attnwarp_eval.plan import plan
from attnwarp_eval.report.effects import effects as section
from attnwarp_eval.report.results import Results
from attnwarp_eval.scene_file import load_scene


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(effects_table, "PICTURE_SIZE", 16)
    monkeypatch.setattr(effects_table, "PLAN_SAMPLES", 16)
    monkeypatch.setattr(effects_table, "FULL_SAMPLES", 16)
    monkeypatch.setattr(effects_table, "measure", functools.partial(effects.measure, size=16, spp=4))


def test_the_table_has_every_scene_and_goes_on_where_it_was(small, monkeypatch, tmp_path):
    made = []
    real = effects_table._entry
    monkeypatch.setattr(effects_table, "_entry", lambda scene, *a: made.append(scene.name) or real(scene, *a))
    quick = Settings(prove=False, rounds=2)
    collect(["spheres", "glass"], tmp_path, quick)
    collect(["spheres", "glass", "mirror"], tmp_path, quick)
    assert made == ["spheres", "glass", "mirror"]
    data = json.loads((tmp_path / "effects.json").read_text())
    by_name = {entry["scene"]: entry for entry in data["scenes"]}
    assert "refraction" in by_name["glass"]["needed"] and "specular" in by_name["mirror"]["needed"]
    assert by_name["spheres"]["left_out"] == ["interreflection"]
    text = (tmp_path / "effects.md").read_text()
    assert "| mirror | interreflection, specular, environment | " in text and " | path | not asked | " in text
    assert text.count(".jpg)") == 3 and "3 scenes, 0 of their plans certified" in text
    # Another setting is another entry; a picture that is gone is drawn again.
    collect(["glass"], tmp_path, Settings(prove=False, rounds=3))
    (tmp_path / "mirror.jpg").unlink()
    collect(["mirror"], tmp_path, quick)
    assert made[3:] == ["glass", "mirror"] and (tmp_path / "mirror.jpg").is_file()


def test_a_proof_stands_in_the_table_with_its_bound_and_the_smallest_difference(small, tmp_path):
    (entry,) = collect(["spheres"], tmp_path, Settings(rounds=0, pictures=False))
    assert entry["proof"]["verdict"] == "certified"
    ((_, _, _, _, verdict, bound, smallest, faster, equal),) = effects_table.table([entry]).rows
    assert verdict == "certified" and float(bound.rstrip("%")) < 1 and "picture" in smallest and "pixel" in smallest
    assert (faster, equal) == ("–", "–")


def test_a_dropped_light_shows_in_the_pictures_side_by_side(small, monkeypatch, tmp_path):
    scene = make([FLOOR], [SUN, SKY])
    same = side_by_side(scene, tmp_path / "same.jpg")["largest_difference"]
    # The plan of a careless planner: the sun alone.
    without_sky = lambda scene, spp=None: effects_table.replace(plan(scene, spp), passes=plan(scene, spp).passes[:1])  # noqa: E731
    monkeypatch.setattr(effects_table, "plan", without_sky)
    dark = side_by_side(scene, tmp_path / "dark.jpg")["largest_difference"]
    assert same < 0.01 < 0.1 < dark
    picture = cv2.imread(str(tmp_path / "dark.jpg"))
    assert picture.shape == (16, 3 * 16 + 8, 3)
    assert picture[:, -16:].mean() < 60 and abs(cv2.imread(str(tmp_path / "same.jpg"))[:, -16:].mean() - 127.5) < 6


def test_a_file_of_something_else_is_refused_and_one_scene_or_all_must_be_asked_for(tmp_path):
    (tmp_path / "effects.json").write_text("{}")
    runner = CliRunner()
    for arguments, words in (
        (["--all", "--out", str(tmp_path)], "it is not a table of effects"),
        ([], "name one scene, or say --all"),
        (["spheres", "--all"], "name one scene, or say --all"),
        (["--all", "--json"], "--json is of one scene"),
    ):
        result = runner.invoke(app, ["scenes", "effects", *arguments])
        assert result.exit_code == 2 and words in " ".join(result.output.split())


def test_the_report_says_which_effects_the_studys_scenes_call_for():
    def cell(name, said):
        record = {"views": [], "pictures": [], "effects": said_by(load_scene(said))} if said else {"views": []}
        return {
            "id": name,
            "title": name,
            "scene": name,
            "variants": [],
            "probe": "calibration",
            "seed": 0,
            "record": record,
        }

    (found,) = section(Results({}, [cell("fog", "fog"), cell("old", None)], []))
    ((scene, usual, beyond, missing, planned, full, why),) = found.tables[0].rows
    assert scene == "fog" and "shadows" in usual and "medium (" in beyond and missing == "–"
    assert planned == full == "volpath" and "medium" in why
    assert section(Results({}, [cell("old", None)], [])) == []
    assert plan_words(plan(load_scene("lens")).to_dict()) == "direct, thin lens"


def test_differences_are_shown_about_grey():
    assert np.isclose(0.5 + effects_table.AMPLIFIED / 2 * 0.125, 1.0)
