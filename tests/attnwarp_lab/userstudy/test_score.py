"""Oracle: choices counted by hand."""

import json
import re

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from attnwarp_eval.cli.main import app
from attnwarp_lab.userstudy.answers import read_answers
from attnwarp_lab.userstudy.draw import SCRAMBLED
from attnwarp_lab.userstudy.score import score as scored


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
    result = scored(read_answers(paths)[0]).frequency
    warped = result["overall"]["warped"]  # 3 of 4, and 0 of 2
    shares = [3 / 4, 0]
    low, high = stats.t.interval(0.95, 1, np.mean(shares), stats.sem(shares))
    assert [warped.mean, warped.low, warped.high] == pytest.approx([3 / 8, low, high])
    assert (warped.views, warped.scenes) == (6, 2)  # times it was shown, and people
    assert result["quality"]["warped"].mean == pytest.approx((2 / 3 + 0) / 2)
    assert np.isnan(result["consistency"]["alone"].mean)  # never shown
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
    done = score(*paths)
    assert done.exit_code == 0
    assert "failed an attention check: asleep." in done.stdout
    result = scored(read_answers(paths)[0])
    assert result.frequency["quality"]["a"].mean == 1
    assert [person.name for person in result.counted] == ["p1", "p2"]
    done = score(paths[2])
    assert done.exit_code == 3 and "no choices of people who passed" in done.stderr


def test_a_person_who_saved_twice_counts_once(tmp_path):
    made = [choice("quality", "a", "b", "left"), choice("instruction", "a", "b", "left")]
    early = answers(tmp_path, "early", made[:1], person="p")
    late = answers(tmp_path, "late", made, person="p")
    other = answers(tmp_path, "other", made)
    done = score(early, late, other)
    assert f"{early}: left out, as {late} has the same person's answers" in done.stderr
    assert "2 people made 4 choices between 2 methods" in done.stdout


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
