"""Tasks are stored and resumed as cells are. Oracles: squares, and the file system."""

import json

import pytest
from edit_folders import Watched

from attnwarp_eval import cost
from attnwarp_eval.canonical_json import digest
from attnwarp_eval.study.store import Store
from attnwarp_eval.study.task import Task, results


def squares(computed, interrupted=None):
    """Squares of 2, 3 and 4, with a picture each; computing ``interrupted`` is stopped."""

    def task(store, x):
        def compute(report):
            if x == interrupted:
                raise KeyboardInterrupt
            report.step(0, 0, f"{x} times {x}")
            computed.append(x)
            path = store.root / f"{x}.png"
            path.write_bytes(bytes(x))
            return {"y": x * x, "pictures": [store.keep_picture(path, view=str(x))]}

        return Task(f"{x} squared", {"x": x}, compute, lambda record: record["y"])

    return lambda store: (task(store, x) for x in (2, 3, 4))


def test_tasks_that_were_interrupted_go_on_and_leave_the_bytes_of_a_whole_run(tmp_path):
    computed, told = [], []
    with pytest.raises(KeyboardInterrupt):
        list(
            results(
                Store(tmp_path / "a"), squares(computed, interrupted=4)(Store(tmp_path / "a")), 3
            )
        )
    assert computed == [2, 3]
    for folder, expected in (("a", [2, 3, 4]), ("b", [2, 3, 4, 2, 3, 4])):
        store = Store(tmp_path / folder)
        values = results(
            store, squares(computed)(store), 3, Watched(lambda *step: told.append(step))
        )
        assert list(values) == [4, 9, 16] and computed == expected
    files = [p.relative_to(tmp_path / "b") for p in (tmp_path / "b").rglob("*") if p.is_file()]
    assert len(files) == 7  # three records, three pictures and the lock
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    assert told[:4] == [
        (0, 3, "2 squared"),
        (1, 3, "3 squared"),
        (2, 3, "4 squared"),
        (2, 3, "4 times 4"),
    ]


def test_results_of_other_code_are_computed_again_and_name_the_code_that_made_them(
    tmp_path, monkeypatch
):
    store, computed = Store(tmp_path), []
    for source in ("one", "one", "two"):
        monkeypatch.setattr(cost, "source_hash", lambda source=source: source)
        cost.environment.cache_clear()
        assert list(results(store, squares(computed)(store), 3)) == [4, 9, 16]
        # What is written beside them is this environment.
        assert store.read(digest({"x": 3}))["environment"]["source"] == source
    assert computed == [2, 3, 4] * 2
    monkeypatch.undo()
    cost.environment.cache_clear()


@pytest.mark.parametrize("damage", ["digit", "cut", "other shape", "picture"])
def test_a_damaged_record_is_computed_again(tmp_path, damage):
    store, computed = Store(tmp_path), []
    assert list(results(store, squares(computed)(store), 3)) == [4, 9, 16]
    path = store.path(digest({"x": 3}))
    whole = path.read_text()
    if damage == "digit":
        path.write_text(whole.replace('"y": 9', '"y": 8'))
    elif damage == "cut":
        path.write_text(whole[:-9])
    elif damage == "other shape":  # sealed all the same
        store.write({"id": digest({"x": 3}), "spec": {"x": 3}})
    else:
        (tmp_path / "3.png").write_bytes(b"x")
    assert list(results(store, squares(computed)(store), 3)) == [4, 9, 16]
    assert computed == [2, 3, 4, 3] and path.read_text() == whole
    assert json.loads(whole)["y"] == 9 and (tmp_path / "3.png").read_bytes() == bytes(3)
