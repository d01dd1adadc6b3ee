"""A stored run: today's code verifies it and writes the same report.

``data/runs.tar.xz`` holds ``variants`` (the probes of variants on two scenes, 24 x 24 px), with the
files of ``report --no-timings --no-pictures``.
Where the report's words or the rules of its verdicts are changed on purpose, read the difference and put the
new report.md there. The runs' two scenes have direct light, so they are given that here. Where a protocol or
the format is changed on purpose, run the studies in their study.json again and put the new folders there.
"""

import base64
import hashlib
import json
import lzma
import shutil
from pathlib import Path

import pytest
import written_runs
from direct_light import direct
from typer.testing import CliRunner

from attnwarp_eval.cli.main import app
from attnwarp_eval.report import write_report
from attnwarp_eval.report.raw import write_raw
from attnwarp_eval.study import Store
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probe_report import Layout, report_of
from attnwarp_eval.study.run import verify

REPORTS = Path(__file__).parents[3] / "reports"


@pytest.fixture(autouse=True)
def scenes_of_direct_light(monkeypatch):
    monkeypatch.setattr("attnwarp_eval.study.run.load_scene", direct)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return written_runs.unpack_stored(tmp_path_factory.mktemp("stored"))


def test_ids_records_and_reports_are_the_bytes_that_they_were(folder):
    store = Store(folder / "variants")
    # The ids follow from the study, the scenes and the protocols of today.
    problems = verify(store)
    assert problems.ok, problems
    assert problems.checked == 16
    for cell in store.done():
        data = store.read(cell)
        stored = store.path(cell).read_bytes()
        store.write(probe(data["spec"]["probe"]).read(data).to_json())
        assert store.path(cell).read_bytes() == stored

    files = ("report.md", "results.jsonl")
    expected = {file: (store.root / file).read_bytes() for file in files}
    for file in files:
        (store.root / file).unlink()
    write_report(store, timings=False, pictures=False)
    assert {file: (store.root / file).read_bytes() for file in files} == expected


def test_a_run_of_an_older_version_is_refused_in_one_line(folder, tmp_path):
    shutil.copytree(folder / "variants", tmp_path / "run")
    path = tmp_path / "run" / "study.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": 1}))
    for command in (["report"], ["verify"], ["compare", str(folder / "variants")]):
        done = CliRunner().invoke(app, [*command, str(tmp_path / "run")])
        assert done.exit_code == 2, done.output
        assert done.stderr.endswith(f"{path}: made by an older version; run it again\n")
        assert done.stderr.count("\n") == 1 and not done.stdout


SECRET = b"nobody's but mine"


def shown(data, path):
    """The JSON of a record, with a file in the place of each picture."""
    views, sha256 = [view["view"] for view in data["views"]], hashlib.sha256(SECRET).hexdigest()
    named = [{"view": v, "what": w, "path": path, "sha256": sha256}
             for v in views for w in ("mask", "warped", "truth", "depth")]  # fmt: skip
    return data | {"pictures": named}


@pytest.mark.parametrize("how", ["above", "absolute", "link"])
def test_a_run_from_elsewhere_shows_no_file_outside_its_folder(folder, tmp_path, how):
    """Oracle: the bytes of a file beside the run, which a record names with its right hash."""
    secret, store = tmp_path / "secret.jpg", Store(tmp_path / "run")
    shutil.copytree(folder / "variants", store.root)
    secret.write_bytes(SECRET)
    (store.root / "pictures").mkdir()
    (store.root / "pictures/linked.jpg").symlink_to(secret)
    path = {"above": "../secret.jpg", "absolute": str(secret), "link": "pictures/linked.jpg"}[how]
    for cell in store.done():
        store.write(shown(store.read(cell), path))
    done = CliRunner().invoke(app, ["verify", str(store.root)])
    assert done.exit_code == 3 and "names a file that is not of the run" in done.stdout
    done = CliRunner().invoke(app, ["report", str(store.root)])
    assert done.exit_code == 3
    assert base64.b64encode(SECRET) not in (store.root / "report.html").read_bytes()


@pytest.mark.door
def test_raw_results_from_elsewhere_show_no_file(folder, tmp_path):
    (tmp_path / "secret.jpg").write_bytes(SECRET)
    raw = write_raw(Store(folder / "variants"), tmp_path / "raw/results.jsonl.xz")
    head, *lines = lzma.decompress(raw.read_bytes()).decode().splitlines()
    cells = [json.loads(line) for line in lines]
    changed = [json.dumps(c | {"record": shown(c["record"], "../secret.jpg")}) for c in cells]
    raw.write_bytes(lzma.compress("\n".join([head, *changed]).encode()))
    done = CliRunner().invoke(app, ["report", str(raw.parent)])
    assert done.exit_code == 0, done.output
    assert base64.b64encode(SECRET) not in (raw.parent / "report.html").read_bytes()


MOST_LINES = 150
"""Lines of report.md that a person reads."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", sorted({path.parent.name for path in REPORTS.rglob("results*.jsonl.xz")})
)
def test_the_report_of_every_committed_run_is_one_page(name, tmp_path):
    done = CliRunner().invoke(app, ["report", str(REPORTS / name), "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    lines = (tmp_path / "report.md").read_text().splitlines()
    assert len(lines) <= MOST_LINES
    assert len(list(tmp_path.glob("figures/*"))) <= 6


def test_the_long_report_has_the_tables_that_are_folded_on_the_page(folder, tmp_path):
    run = str(folder / "variants")
    for option in ([], ["--long"]):
        out = str(tmp_path / f"out{len(option)}")
        done = CliRunner().invoke(app, ["report", run, "--out", out, *option])
        assert done.exit_code == 0, done.output
    short, long = ((tmp_path / f"out{k}/report.md").read_text() for k in range(2))
    assert len(short.splitlines()) <= MOST_LINES < len(long.splitlines())
    assert "<details>" not in short and "## Calibration" in long
    # Every row of the short one stands in the long one, and every table of that one in the page.
    assert set(short.splitlines()) <= set(long.splitlines())
    page = (tmp_path / "out0/report.html").read_text()
    assert page.count("<tr") == sum(line.startswith("|") for line in long.splitlines()) - sum(
        line.startswith("|---") for line in long.splitlines()
    )


@pytest.mark.parametrize(("size", "small"), [(255, True), (256, False)])
def test_the_calibration_says_where_the_pictures_are_small(tmp_path, size, small):
    study = {"name": "s", "scenes": ["a"], "size": size, "probes": {"calibration": []}}
    data = written_runs.record([])
    cell = written_runs.outcome("calibration", "a", ["calibration"], data)
    made = report_of("calibration").sections(written_runs.results(study, [cell]), Layout(tmp_path))
    (section,) = [section for section in made if section.title == "Calibration"]
    words = f"The pictures are small: at {size} px, "
    assert sum(text.startswith(words) for text in section.text) == small
    assert ("The pictures are small" in "".join(section.text)) == small
