"""Oracles: the stored run itself, SciPy's binomial, ratios by hand, and the documents that are
committed.
"""

import dataclasses
import json
import lzma
import pathlib

import numpy as np
import pytest
import written_runs
from scipy import stats
from typer.testing import CliRunner

from attnwarp.errors import InputError
from attnwarp_eval.canonical_json import digest
from attnwarp_eval.cli.main import app
from attnwarp_eval.report import read_results
from attnwarp_eval.report.claims import load_claims
from attnwarp_eval.report.judging import claim_row, judge, judged, measured
from attnwarp_eval.report.raw import PARTS, read_parts, read_raw, together
from attnwarp_eval.report.results import lines
from attnwarp_eval.report.verdicts import filled, headlines, table, verdicts
from attnwarp_eval.statistics.contrasts import contrast
from attnwarp_eval.study import Store
from attnwarp_eval.study.study import parse_study

ROOT = pathlib.Path(__file__).parents[3]
SLIP = "warp.epe_median_layer.64"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return written_runs.unpack_stored(tmp_path_factory.mktemp("stored"))


@pytest.fixture(scope="module")
def reported(folder, tmp_path_factory):
    """A stored run that is reported with its raw results, and their folder."""
    store, raw = Store(folder / "variants"), tmp_path_factory.mktemp("raw")
    done = invoke("report", store.root, "--no-pictures", "--raw", raw)
    assert done.exit_code == 0 and str(raw / "results.jsonl.xz") in done.output
    return store, raw


def invoke(*arguments):
    return CliRunner().invoke(app, list(map(str, arguments)))


def written(folder, scenes, factors, *, name="suite", rounds=None):
    """A run of 8 drawn scenes, or a part of it, in a folder of its own."""
    content = {
        "name": name,
        "scenes": {"drawn": 8, "seed": 1010},
        "variants": {"good": {}, "slipped": {"set": {"pixel_centers": "integer"}}},
        "probes": {
            "warp": ["good", "slipped"],
            **({"timing": ["good", "slipped"]} if rounds else {}),
        },
    }
    study = parse_study(content)
    chosen = [s for s in study.scenes if pathlib.Path(s).stem in scenes]
    store, cells = Store(folder), []

    def add(probe, scene, variants, data):
        spec = {**data["spec"], "probe": probe, "scene": scene, "who": variants}
        store.write({**data, "id": digest(spec), "spec": spec})
        cells.append(
            {"id": digest(spec), "title": "t", "scene": scene, "variants": variants,
             "probe": probe, "seed": 0}
        )  # fmt: skip

    for scene, factor in zip(scenes, factors, strict=True):
        for who, value in (("good", 0.1), ("slipped", 0.1 * factor)):
            add("warp", scene, [who], written_runs.record([("v0", 30.0, {SLIP: value})]))
    if rounds:
        # The baseline's second run comes last.
        each = [[1.0] * rounds, [2.0] * rounds, [1.0] * rounds]
        spec = {"rounds": rounds, "views": ["v0"]}
        cost = {"rounds": {"render": each, "pair": each}}
        add("timing", scenes[0], ["good", "slipped"], written_runs.record([], spec=spec, cost=cost))
    store.write_study(
        {"study": study.model_copy(update={"scenes": chosen}).model_dump(mode="json"),
         "scenes": {scene: {"hash": "", "title": ""} for scene in scenes}, "cells": cells}
    )  # fmt: skip
    return store


SCENES = [f"drawn-{k}" for k in range(8)]


def defined(value):
    """Figures, with NaN for what JSON has as null."""
    if isinstance(value, dict):
        return {key: defined(item) for key, item in value.items()}
    return np.nan if value is None else value


def test_raw_results_outlive_the_keys_of_their_study(reported, tmp_path):
    path = reported[1] / "results.jsonl.xz"
    head, *cells = lzma.decompress(path.read_bytes()).decode().splitlines()
    older = json.loads(head)
    variant = next(iter(older["study"]["variants"].values()))
    older["study"]["gone"] = variant["gone"] = None
    text = "\n".join([json.dumps(older), *cells])
    (tmp_path / "older.jsonl.xz").write_bytes(lzma.compress(text.encode()))
    assert read_raw(tmp_path / "older.jsonl.xz").study == read_raw(path).study


def test_raw_results_hold_every_figure_of_the_run_and_no_path_of_this_machine(reported):
    store, raw = reported
    path = raw / "results.jsonl.xz"
    kept, whole = (lines(results, False) for results in (read_raw(path), read_results(store)))
    assert len(kept) == len(whole)
    for one, other in zip(map(json.loads, kept), map(json.loads, whole), strict=True):
        for name in ("value", "views"):  # of six digits, and means
            expected = defined(other.pop(name))
            close = pytest.approx(expected, rel=1e-5, abs=1e-6, nan_ok=True)  # differences
            assert defined(one.pop(name)) == close
        assert one == other
    assert str(pathlib.Path.home()) not in lzma.decompress(path.read_bytes()).decode()
    # Raw results, their folder, and the run's own table of figures in the place of its folder.
    for baseline in (path, raw, store.root / "results.jsonl"):
        same = invoke("compare", baseline, store.root)
        assert same.exit_code in (0, 3), same.output
        assert "0 worse, 0 can't tell, 0 better" in same.output


def test_a_folder_of_raw_results_gives_the_report_of_its_run(reported):
    store, raw = reported
    done = invoke("report", raw)
    assert done.exit_code == 0 and str(raw / "report.html") in done.output
    assert (raw / "report.md").read_text() == (store.root / "report.md").read_text()


def test_damaged_raw_results_are_refused_with_what_to_do(tmp_path):
    path = tmp_path / "results.jsonl.xz"
    for content in (b"nothing", lzma.compress(b"[]"), lzma.compress(b'{"raw": 0}')):
        path.write_bytes(content)
        done = invoke("compare", path, tmp_path)
        assert done.exit_code == 2
        with pytest.raises(InputError, match="report RUN --raw"):
            read_raw(path)


def test_the_table_has_verdict_difference_and_time_and_parts_of_a_study_are_read_together(
    tmp_path, slip_declared
):
    factors = np.exp(np.linspace(0.5, 1.2, 8))
    reports = tmp_path / "reports"
    for k, half in enumerate((slice(0, 3), slice(3, 8))):
        store = written(tmp_path / f"run{k}", SCENES[half], factors[half], rounds=7)
        target = reports / "suite" / f"results-{k}.jsonl.xz"
        how = ("--raw", target, "--no-pictures", "--latex", "--csv")
        assert invoke("report", store.root, *how).exit_code == 0
        names = {path.name for path in (store.root / "tables").iterdir()}
        assert {"01-calibration.tex", "01-calibration.csv"} <= names
    claims = verdicts(reports)
    (slip,) = [one for one in claims if one.comparison is not None]
    assert slip.claim.id == "half-pixel-slip"
    assert slip.comparison.p == pytest.approx(stats.binomtest(8, 8).pvalue)
    whole = table(claims, tmp_path)
    (cells,) = [row for row in whole.rows if row[-1] != "–"]
    row = dict(zip(whole.columns, cells, strict=True))
    assert row["verdict"] == "holds" and row["scenes × seeds"] == "8 × 1"
    # Without any one of eight scenes the seven others are still all of one sign: p = 2 / 2**7.
    assert row["hangs on"] == "0 of 8"
    spread = np.log(factors).std(ddof=1)
    assert row["spread over scenes, seeds"] == f"{spread:.2g}, –"
    assert row["difference"].startswith(f"× {np.exp(np.log(factors).mean()):.2f} (")
    assert row["time"] == "2.00 [2.00, 2.00], 2 scenes"
    assert row["report"] == "[suite](reports/suite/report.md)"
    mean = 0.1 * factors.mean()
    assert row["measured"] == f"{mean:.2f} px of a 64 grid against 0.10 px of a 64 grid"
    (line,) = headlines(claims)
    # With factors from 1.6 to 3.3 the mean of the logarithms is 0.85.
    assert line.endswith("Holds: 2.3 times the error, over 8 scenes.")
    priced = dataclasses.replace(slip.claim, plain="The price")
    price = dataclasses.replace(slip, claim=priced)
    assert headlines([slip, price]) == [f"{line} **The price.** {line.partition('.** ')[2]}"]
    document = tmp_path / "README.md"
    document.write_text("a\n<!-- verdicts -->\nold\n<!-- /verdicts -->\nb\n")
    assert invoke("verdicts", reports, "--write", document).exit_code == 0
    text = document.read_text()
    assert text.startswith("a\n<!-- verdicts -->\n") and text.endswith("<!-- /verdicts -->\nb\n")
    assert "| holds |" in text and "\nold\n" not in text
    assert text == filled(text, claims, tmp_path)


def test_sides_that_are_equal_to_the_last_digit_were_not_tried(tmp_path, slip_declared):
    (one,) = judge(read_results(written(tmp_path / "run", SCENES, [1.0] * 8)), load_claims())
    assert claim_row(one)[1] == "can't tell: both sides are equal to the last digit"


def test_a_run_of_the_study_on_other_scenes_than_were_declared_judges_nothing(
    tmp_path, slip_declared
):
    path = tmp_path / "suite" / "results.jsonl.xz"
    store = written(tmp_path / "run", SCENES, [2.0] * 8)
    assert invoke("report", store.root, "--no-pictures", "--raw", path).exit_code == 0
    head, *cells = lzma.decompress(path.read_bytes()).decode().splitlines()
    for seed, told in ((1010, "holds"), (1011, "not measured: `suite` judges it")):
        study = json.loads(head)
        study["study"]["population"]["seed"] = seed
        path.write_bytes(lzma.compress("\n".join([json.dumps(study), *cells]).encode()))
        assert table(verdicts(tmp_path), tmp_path).rows[0][1] == told


def test_parts_of_other_studies_and_two_runs_of_one_are_refused(tmp_path, slip_declared):
    runs = [written(tmp_path / name, SCENES, [2.0] * 8, name=name) for name in ("suite", "fitted")]
    parts = [read_results(store) for store in runs]
    with pytest.raises(InputError, match="parts differ in name"):
        together(parts)
    for place in ("one", "two"):
        invoke("report", runs[0].root, "--no-pictures", "--raw", tmp_path / "reports" / place)
    done = invoke("verdicts", tmp_path / "reports")
    assert done.exit_code == 2 and "keep those of one run" in done.stderr


def test_a_folder_without_raw_results_says_how_to_write_them(tmp_path):
    done = invoke("verdicts", tmp_path)
    assert done.exit_code == 3 and "--raw" in done.stderr
    assert done.stdout.count("not measured") == len(verdicts(tmp_path))
    document = tmp_path / "other.md"
    document.write_text("nothing here\n")
    done = invoke("verdicts", tmp_path, "--write", document)
    assert done.exit_code == 2 and "has no place for verdicts" in done.stderr


def test_the_documents_say_what_the_committed_raw_results_give():
    told = verdicts(ROOT / "reports")  # seconds, for both documents
    for path in (ROOT / "README.md", ROOT / "reports/README.md"):
        text = path.read_text()
        assert "<!-- /" in text
        assert filled(text, told, path.parent) == text


@pytest.mark.slow
def test_halves_of_the_committed_populations_contradict_each_other_in_no_verdict():
    folders = {path.parent for path in (ROOT / "reports").rglob(PARTS)}
    wholes = [whole for whole in map(read_parts, sorted(folders)) if whole.study.population]
    halves = []
    for odd in (0, 1):
        one = []
        for whole in wholes:
            scenes = whole.study.scene_names[odd::2]
            study = whole.study.model_copy(update={"scenes": whole.study.scenes[odd::2]})
            own = [cell for cell in whole.cells if cell.scene in scenes]
            claims = [c for c in load_claims() if c.study == study.name]
            one += measured(dataclasses.replace(whole, study=study, cells=own), claims)
        # Half of the planned scenes is not finished.
        every = judged(dataclasses.replace(each, word="") for each in one)
        halves.append({each.claim.text: each.word for each in every})
    assert halves[0].keys() == halves[1].keys() and len(halves[0]) > 10
    opposite = {"better", "worse"}
    pairs = {text: {word, halves[1][text]} for text, word in halves[0].items()}
    assert [text for text, pair in pairs.items() if pair == opposite] == []
    agreeing = [text for text, pair in pairs.items() if len(pair & opposite) == len(pair) == 1]
    assert len(agreeing) > 3  # the halves do tell


def test_of_200_simulated_runs_of_equal_arms_few_judge_and_no_interval_disagrees(
    tmp_path, slip_declared
):
    """Five claims a run, on the odds of shares: adjusted together, one in twenty runs may tell."""
    store = written(tmp_path / "run", SCENES, [1.0] * 8)
    (one,) = measured(read_results(store), load_claims())
    rng, told = np.random.default_rng(4), 0
    for _ in range(200):
        family = []
        for _ in range(5):
            k = rng.binomial(40, np.clip(rng.normal(0.5, 0.2, 12), 0.05, 0.95), (2, 12))
            a, b = ({f"s{i}": {"v": x / 40} for i, x in enumerate(side)} for side in k)
            of = {f"s{i}": {"v": 40} for i in range(12)}
            value = contrast(a, b, "share", counts=(of, of))
            claim = dataclasses.replace(one.claim, equal_within=None)
            family.append(dataclasses.replace(one, claim=claim, contrast=value))
        every = judged(family)
        for each in every:
            _, low, high = each.contrast.shown(each.contrast.level(each.p))
            assert (each.word != "can't tell") == (not low <= 1 <= high)
        told += any(each.word != "can't tell" for each in every)
    assert told <= stats.binom.ppf(0.999, 200, 0.05)
