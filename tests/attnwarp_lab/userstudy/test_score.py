"""Oracle: choices counted by hand."""

import json
import re

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from attnwarp_eval.cli.main import app
from attnwarp_lab.userstudy.draw import SCRAMBLED


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


def test_selection_frequency_is_the_mean_of_peoples_shares_with_students_interval(tmp_path):
    """Oracle: counted by hand; scipy's interval of people's shares."""
    one = [
        choice("quality", "alone", "warped", "right", edit="a"),
        choice("quality", "warped", "alone", "left", edit="b"),
        choice("quality", "warped", "alone", "right", edit="c"),
        choice("consistency", "warped", "third", "left", edit="d"),
    ]
    two = [
        choice("quality", "warped", "alone", "right"),
        choice("quality", "third", "warped", "left"),
    ]
    paths = [answers(tmp_path, "one", one), answers(tmp_path, "two", two)]
    done = score(*paths, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    questions = json.loads((tmp_path / "out" / "preferences.json").read_text())["questions"]
    warped = questions["overall"]["warped"]  # 3 of 4, and 0 of 2
    shares = [3 / 4, 0]
    low, high = stats.t.interval(0.95, 1, np.mean(shares), stats.sem(shares))
    assert warped == {"frequency": pytest.approx(3 / 8), "low": pytest.approx(low),
                      "high": pytest.approx(high), "shown": 6, "people": 2}  # fmt: skip
    assert questions["quality"]["warped"]["frequency"] == pytest.approx((2 / 3 + 0) / 2)
    assert questions["consistency"]["alone"]["frequency"] is None  # never shown
    text = (tmp_path / "out" / "preferences.md").read_text()
    (row,) = re.findall(r"^\| alone +\|.*$", text, re.MULTILINE)
    assert [cell.strip() for cell in row.strip("|").split("|")][2] == "–"
    assert (tmp_path / "out" / "preferences.html").read_text().startswith("<!doctype html>")


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
    assert result["questions"]["quality"]["a"]["frequency"] == 1
    assert result["choices"] == {"p1": 1, "p2": 1}
    done = score(paths[2])
    assert done.exit_code == 3 and "no choices of people who passed" in done.stderr


def test_a_person_who_saved_twice_counts_once(tmp_path):
    made = [choice("quality", "a", "b", "left"), choice("instruction", "a", "b", "left")]
    early = answers(tmp_path, "early", made[:1], person="p")
    late = answers(tmp_path, "late", made, person="p")
    other = answers(tmp_path, "other", made)
    done = score(early, late, other, "--out", tmp_path)
    assert f"{early}: left out, as {late} has the same person's answers" in done.stderr
    result = json.loads((tmp_path / "preferences.json").read_text())
    assert result["choices"] == {"p": 2, "other": 2}


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
