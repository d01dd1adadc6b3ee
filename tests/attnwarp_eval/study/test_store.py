"""Oracles: hashlib on bytes written by hand, the file system itself."""

import hashlib
import json
import os
import re
import threading
from contextlib import ExitStack
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from attnwarp.errors import InputWarning
from attnwarp.io.lock import locked
from attnwarp_eval.canonical_json import canonical_json
from attnwarp_eval.cli.main import app
from attnwarp_eval.cost import environment
from attnwarp_eval.files import write_atomic
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.record import Environment
from attnwarp_eval.study.shared import fits
from attnwarp_eval.study.store import Store, StoreError
from attnwarp_eval.study.task import Task, results

SPEC = {"probe": "depth", "scene": "abc", "seed": 0}
TASK = Task("depth", SPEC, lambda report: {"summary": {"x": 1.5}}, lambda record: record["summary"])


def record(**extra):
    return {"id": Cell(SPEC, "s", "v", "depth", 0).id, "spec": SPEC, "summary": {"x": 1.5}, **extra}


def expected(cell_id, title):
    return {
        "id": cell_id,
        "title": title,
        "scene": "s",
        "variants": ["v"],
        "probe": "depth",
        "seed": 0,
    }


def test_a_cells_id_is_the_sha256_of_its_canonical_json():
    text = b'{"probe":"depth","scene":"abc","seed":0}'
    assert Cell(SPEC, "s", "v", "depth", 0).id == hashlib.sha256(text).hexdigest()


def test_nan_cannot_hide_in_canonical_json():
    with pytest.raises(ValueError, match="JSON"):
        canonical_json({"x": float("nan")})


@pytest.mark.door
def test_a_folder_of_others_results_or_the_current_one_with_other_things_is_refused(
    tmp_path, monkeypatch
):
    (tmp_path / "report.md").write_text("mine")
    with pytest.raises(StoreError, match=r"report.md: is there without a study.json, and a run"):
        Store(tmp_path).refuse_strangers()
    (tmp_path / "study.json").write_text("{}")
    Store(tmp_path).refuse_strangers()
    (tmp_path / "new").mkdir()
    monkeypatch.chdir(tmp_path / "new")
    Store("").refuse_strangers()  # as in a folder made for it
    (tmp_path / "new" / "study.yaml").write_text("name: mine")
    with pytest.raises(StoreError, match=r"--out: got '.', the current folder, which holds"):
        Store("").refuse_strangers()
    with pytest.raises(StoreError, match="the current folder, which holds"):
        Store(tmp_path / "new").refuse_strangers()
    (tmp_path / "new" / "cells").mkdir()  # of a run whose study.json is lost
    Store("").refuse_strangers()


@pytest.mark.door
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda r: r["summary"].update(x=1.6), "checksum"),
        (lambda r: r["spec"].update(seed=2), "hash of its spec"),
        (lambda r: r.update(format=1), "made by an older version"),
    ],
)
def test_a_changed_record_is_refused_with_the_remedy(tmp_path, damage, message):
    store = Store(tmp_path)
    store.write(record())
    path = store.path(record()["id"])
    data = json.loads(path.read_text())
    damage(data)
    path.write_text(json.dumps(data))
    with pytest.raises(StoreError, match=message) as caught:
        store.read(record()["id"])
    assert str(path) in str(caught.value)
    assert re.search("run (it )?again", str(caught.value))


@pytest.mark.parametrize("text", ["[]", "NaN", '{"format": 2, "x": 1e999}'])
def test_a_cell_of_another_content_is_refused_in_one_line_and_computed_anew(tmp_path, text):
    store = Store(tmp_path)
    store.write(record())
    whole = store.path(record()["id"]).read_bytes()
    store.path(record()["id"]).write_text(text)
    with pytest.raises(StoreError, match="run again, which computes it anew") as caught:
        store.read(record()["id"])
    assert "\n" not in str(caught.value)
    assert list(results(store, [TASK], 1)) == [{"x": 1.5}]
    # A task's record says besides in which environment it was computed.
    made = store.read(record()["id"])
    assert {key: made[key] for key in record()} == {key: json.loads(whole)[key] for key in record()}


@pytest.mark.door
def test_a_sealed_record_that_its_probe_cannot_read_is_refused_in_one_line(tmp_path):
    store = Store(tmp_path)
    store.write(record())
    with pytest.raises(StoreError, match=r"not a record of its probe \(KeyError: 'views'\)"):
        store.read_as(record()["id"], lambda data: data["views"])


def test_verify_names_missing_failed_damaged_and_unexpected_cells(tmp_path):
    store = Store(tmp_path)
    picture = tmp_path / "pictures" / "a.png"
    write_atomic(picture, b"png")
    good = record(
        pictures=[{"path": "pictures/a.png", "sha256": hashlib.sha256(b"png").hexdigest()}]
    )
    store.write(good)
    other = Cell({**SPEC, "seed": 9}, "s", "v", "depth", 9)
    store.write({"id": other.id, "spec": other.spec})
    store.write_failure("f" * 64, {"error": "ValueError: no"})
    cells = [
        expected(good["id"], "good"),
        expected("f" * 64, "fails"),
        expected("e" * 64, "absent"),
    ]
    store.write_study({"study": {}, "cells": cells})
    problems = store.verify()
    assert problems.missing == ["absent"]
    assert problems.failed == ["fails: ValueError: no"]
    assert problems.unexpected == [other.id]
    assert problems.damaged == []
    assert not problems.ok
    picture.write_bytes(b"other")
    assert "changed since" in store.verify().damaged[0]
    picture.unlink()
    assert "missing" in store.verify().damaged[0]


def test_study_json_carries_the_sha256_of_its_content(tmp_path):
    store = Store(tmp_path)
    content = {"study": {"name": "s"}, "cells": [expected("a" * 64, "first")]}
    store.write_study(content)
    path = tmp_path / "study.json"
    stored = json.loads(path.read_text())
    text = json.dumps({**content, "format": 2}, sort_keys=True, separators=(",", ":"))
    sha256 = hashlib.sha256(text.encode()).hexdigest()
    assert store.read_study() == stored == {**content, "format": 2, "sha256": sha256}
    path.write_text(path.read_text().replace("first", "other"))
    with pytest.raises(StoreError, match=r"study\.json: its checksum does not fit.*writes it anew"):
        store.read_study()
    path.write_text(json.dumps(stored).replace('"sha256"', '"sha257"'))
    with pytest.raises(StoreError, match=r"study\.json: its checksum does not fit"):
        store.read_study()
    path.write_text(json.dumps(content))
    with pytest.raises(StoreError, match=r"study\.json: made by an older version; run it again$"):
        store.read_study()


def test_a_second_run_on_the_same_folder_is_refused_with_the_first_ones_process(tmp_path):
    with (
        Store(tmp_path).lock(),
        pytest.raises(StoreError, match=rf"another run \(process {os.getpid()}\)"),
        Store(tmp_path).lock(),
    ):
        pass


def test_a_fit_that_another_process_makes_is_waited_for_with_a_word(tmp_path, monkeypatch):
    spec = {
        "fit": {"settings": {}, "views": 9, "points": 10, "noise": 0},
        "scene": "", "size": 1, "spp": 1, "seed": 0,
    }  # fmt: skip
    world = SimpleNamespace(scene=None, geometry=None)
    cell = Cell(spec, "bear", "fitted", "fit", 0)
    work = SimpleNamespace(spec=spec, world=world, root=tmp_path, cell=cell)
    monkeypatch.setattr(fits.fitted, "fit_scene", lambda *_, **__: "the other's")
    folder = fits.folder_of(tmp_path, spec)
    folder.mkdir(parents=True)
    with ExitStack() as other:
        other.enter_context(locked(folder / ".lock", wait=False))
        threading.Timer(0.3, other.close).start()
        with pytest.warns(InputWarning, match=f"waits for process {os.getpid()}, which makes"):
            assert fits.fit_of(work) == "the other's"


def test_success_forgets_the_former_failure(tmp_path):
    store = Store(tmp_path)
    store.write_failure(record()["id"], {"error": "x"})
    assert len(store.failures()) == 1
    store.write(record())
    assert store.failures() == []


def test_another_version_of_what_decides_an_edit_is_other_code():
    here = environment()
    # What an edit is computed with, by the names of the package index.
    assert here["versions"].keys() >= {"diffusers", "transformers", "tokenizers", "torch", "scipy"}
    this = Environment.from_json(here)
    assert this.same_code(Environment.from_json(here))
    for name in ("diffusers", "transformers", "attnwarp"):
        versions = {**here["versions"], name: "0.0.1"}
        assert not this.same_code(Environment.from_json({**here, "versions": versions}))


def test_two_states_of_files_that_are_not_committed_are_other_code():
    here = {**environment(), "git": {"sha": "a" * 40, "dirty": True}}
    this = Environment.from_json(here)
    assert this.same_code(Environment.from_json(this.to_json()))
    assert not this.same_code(Environment.from_json({**here, "source": "0" * 64}))
    # A later revision, or one with changes elsewhere, has the code that it has.
    for git in ({"sha": "b" * 40, "dirty": True}, {"sha": "a" * 40, "dirty": False}):
        assert this.same_code(Environment.from_json({**here, "git": git}))


@pytest.mark.parametrize(
    "command",
    [("report",), ("inspect",), ("verify",), ("compare", "other"), ("run", "quick", "--out")],
)
def test_a_run_on_captures_is_told_as_one_where_a_study_is_expected(tmp_path, monkeypatch, command):
    """Oracle: the entries that ``attnwarp-eval captures`` writes."""
    monkeypatch.chdir(tmp_path)
    Store(".").write_study({"manifest": {}, "inputs": {}, "cells": []})
    before = (tmp_path / "study.json").read_bytes()
    done = CliRunner().invoke(app, [*command, "."])
    assert done.exit_code == 2
    assert "is a run on captures (attnwarp-eval captures, which writes its table)" in done.stderr
    assert (tmp_path / "study.json").read_bytes() == before
    Store(tmp_path).write_study({"study": {}, "cells": []})
    with pytest.raises(StoreError, match="is a run of a study"):
        Store(tmp_path).refuse_strangers("manifest")
