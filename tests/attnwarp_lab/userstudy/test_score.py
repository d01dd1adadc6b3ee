"""Oracles: simulated people with planted strengths, and choices counted by hand."""

import json
import re

import numpy as np
import pytest
from typer.testing import CliRunner

from attnwarp_eval.cli.main import app
from attnwarp_lab.userstudy.draw import SCRAMBLED, draw

STRENGTH = {"alone": 0.0, "warped": 1.5, "third": 0.5}
QUESTIONS = ["instruction", "quality"]


def choice(question, left, right, chosen, **changes):
    return {"scene": "ball", "edit": "red", "seed": 0, "question": question, "left": left,
            "right": right, "chosen": chosen, "seconds": 2.0} | changes  # fmt: skip


def answers(folder, name, choices, **changes):
    path = folder / f"{name}.json"
    data = {"format": 1, "study": "s", "title": "Which?", "person": name, "plan": 0,
            "planned": len(choices), "choices": choices} | changes  # fmt: skip
    path.write_text(json.dumps(data))
    return path


def score(*arguments):
    return CliRunner().invoke(app, ["userstudy", "score", *map(str, arguments)])


def simulated(folder, rng, count):
    """People who follow the planted strengths, and see through every check."""
    plans = draw([list(STRENGTH)] * 6, QUESTIONS, plans=count, choices=24, checks=2, seed=3)
    paths = []
    for number, plan in enumerate(plans):
        made = []
        for drawn in plan:
            if drawn.is_check:
                side = "right" if drawn.left == SCRAMBLED else "left"
            else:
                odds = np.exp(STRENGTH[drawn.right] - STRENGTH[drawn.left])
                side = "left" if rng.random() < 1 / (1 + odds) else "right"
            made.append(
                choice(drawn.question, drawn.left, drawn.right, side, edit=f"edit {drawn.item}")
            )
        paths.append(answers(folder, f"p{number}", made))
    return paths


def test_planted_preferences_of_simulated_people_are_recovered(tmp_path):
    paths = simulated(tmp_path, np.random.default_rng(0), 24)
    done = score(*paths, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    result = json.loads((tmp_path / "out" / "preferences.json").read_text())
    names = list(STRENGTH)
    for question, value in result["questions"].items():
        for name, share in value["shares"].items():
            truth = np.mean(
                [
                    1 / (1 + np.exp(STRENGTH[other] - STRENGTH[name]))
                    for other in names
                    if other != name
                ]
            )
            assert share["low"] <= truth <= share["high"]
            # 24 people x 8 (or 16) choices of a method: a standard error of 0.036 at most.
            assert share["value"] == pytest.approx(truth, abs=4 * 0.036)
        assert value["people"] == 24 and sum(map(sum, value["wins"])) == 24 * (
            24 if question == "overall" else 12
        )
    page = (tmp_path / "out" / "preferences.md").read_text()
    assert "alone | warped" in page and "warped preferred" in page
    assert (tmp_path / "out" / "preferences.html").read_text().startswith("<!doctype html>")


def test_selection_frequency_counts_how_often_what_was_shown_was_chosen(tmp_path):
    """Oracle: counted by hand."""
    made = [
        choice("quality", "alone", "warped", "right", edit="a"),
        choice("quality", "warped", "alone", "left", edit="b"),
        choice("quality", "warped", "alone", "right", edit="c"),
        choice("consistency", "warped", "third", "left", edit="d"),
    ]
    done = score(answers(tmp_path, "one", made), "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    questions = json.loads((tmp_path / "out" / "preferences.json").read_text())["questions"]
    assert questions["overall"]["selection_frequency"] == {
        "alone": 1 / 3,
        "third": 0,
        "warped": 3 / 4,
    }
    assert questions["quality"]["selection_frequency"] == {
        "alone": 1 / 3, "third": None, "warped": 2 / 3,
    }  # fmt: skip
    text = (tmp_path / "out" / "preferences.md").read_text()
    (row,) = re.findall(r"^\| warped +\|.*%.*$", text, re.MULTILINE)
    assert [cell.strip() for cell in row.strip("|").split("|")] == [
        "warped", "75% of 4", "100% of 1", "67% of 3",
    ]  # fmt: skip


def test_who_chose_a_scrambled_side_is_named_and_does_not_count(tmp_path):
    good = [choice("quality", "a", "b", "left"), choice("quality", SCRAMBLED, "a", "right")]
    bad = [choice("quality", "a", "b", "right"), choice("quality", SCRAMBLED, "a", "left")]
    paths = [
        answers(tmp_path, "p1", good),
        answers(tmp_path, "p2", good),
        answers(tmp_path, "asleep", bad),
    ]
    done = score(*paths, "--out", tmp_path)
    assert done.exit_code == 0
    assert "failed an attention check: asleep." in done.stdout
    result = json.loads((tmp_path / "preferences.json").read_text())
    assert result["failed"] == ["asleep"]
    assert result["questions"]["quality"]["wins"] == [[0, 2], [0, 0]]
    assert result["people"]["asleep"]["failed"] == 1
    done = score(paths[2])
    assert done.exit_code == 3 and "no choices of people who passed" in done.stderr


def test_agreement_counts_the_same_comparison_on_either_side(tmp_path):
    paths = [
        answers(
            tmp_path,
            "p1",
            [choice("quality", "a", "b", "left"), choice("quality", "a", "c", "left")],
        ),
        answers(
            tmp_path,
            "p2",
            [choice("quality", "b", "a", "right"), choice("quality", "a", "c", "right")],
        ),
        answers(tmp_path, "p3", [choice("quality", "b", "c", "left")]),
    ]
    assert score(*paths, "--out", tmp_path).exit_code == 0
    result = json.loads((tmp_path / "preferences.json").read_text())
    assert result["questions"]["overall"]["agreement"] == {
        "share": 0.5,
        "kappa": 0.0,
        "comparisons": 2,
    }


def test_a_person_who_saved_twice_counts_once(tmp_path):
    made = [choice("quality", "a", "b", "left"), choice("instruction", "a", "b", "left")]
    early = answers(tmp_path, "early", made[:1], person="p")
    late = answers(tmp_path, "late", made, person="p")
    other = answers(tmp_path, "other", made)
    done = score(early, late, other, "--out", tmp_path)
    assert f"{early}: left out, as {late} has the same person's answers" in done.stderr
    assert json.loads((tmp_path / "preferences.json").read_text())["questions"]["overall"][
        "wins"
    ] == [[0, 4], [0, 0]]
    changed = answers(tmp_path, "changed", [choice("quality", "a", "b", "right")], person="p")
    done = score(late, changed)
    assert done.exit_code == 2 and "the same person as in" in done.stderr


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "Invalid JSON"),
        ("[]", "expected answers of format 1"),
        ({"format": 2}, "format: Input should be 1"),
        ({"choices": [choice("quality", "a", "b", "middle")]}, "choices.0.chosen"),
        ({"choices": [choice("quality", "a", "a", "left")]}, "both sides are 'a'"),
        (
            {"choices": [choice("quality", "a", "b", "left", seconds=float("nan"))]},
            "choices.0.seconds",
        ),
        ({"extra": 1}, "extra"),
    ],
)
def test_files_that_are_not_the_pages_are_one_line(tmp_path, content, message):
    path = tmp_path / "a.json"
    if isinstance(content, str):
        path.write_text(content)
    else:
        answers(tmp_path, "a", **({"choices": []} | content))
    done = score(path)
    assert done.exit_code == 2 and message in done.stderr and done.stderr.count("\n") == 1
    assert str(path) in done.stderr


def test_answers_of_two_pages_are_not_mixed(tmp_path):
    made = [choice("quality", "a", "b", "left")]
    paths = [answers(tmp_path, "p1", made), answers(tmp_path, "p2", made, study="t")]
    done = score(*paths)
    assert done.exit_code == 2 and "answers of another page than" in done.stderr
    done = score(tmp_path / "none.json")
    assert done.exit_code == 2 and "No such file" in done.stderr


def test_a_file_in_place_of_the_results_folder_is_answered_before_the_work(tmp_path):
    taken = tmp_path / "taken"
    taken.write_text("mine")
    done = score(answers(tmp_path, "a", [choice("q", "x", "y", "left")]), "--out", taken)
    assert done.exit_code == 2
    assert "taken: --out is a file, expected a folder" in done.output.replace("\n", "")
    assert taken.read_text() == "mine"


def test_one_person_is_not_called_people(tmp_path):
    done = score(answers(tmp_path, "a", [choice("q", "x", "y", "left")]))
    assert done.output.startswith("1 person made 1 choice between 2 methods")
