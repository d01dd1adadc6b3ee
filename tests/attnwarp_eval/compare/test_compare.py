"""A run against a baseline. Oracles: planted changes whose size is known, and SciPy's tests.

The run is the stored one of ``data/runs.tar.xz``: two scenes, 24 x 24 px.
"""

import dataclasses
import json
import math
import shutil

import numpy as np
import pytest
import written_runs
from chord_probe import Chord, Longest
from scipy import stats
from typer.testing import CliRunner

from attnwarp_eval.canonical_json import digest
from attnwarp_eval.cli.main import app
from attnwarp_eval.compare import Snapshot, compare, read_baseline, read_snapshot, write_baseline
from attnwarp_eval.compare.judge import _means_of_shared
from attnwarp_eval.compare.snapshot import Figure, Measured, shortened, snapshot
from attnwarp_eval.compare.write import document, summary
from attnwarp_eval.cost import environment
from attnwarp_eval.metrics.gates import GATES, gated
from attnwarp_eval.metrics.registry import METRICS
from attnwarp_eval.report.results import read_results
from attnwarp_eval.study import Store
from attnwarp_eval.study.probe import register, unregister
from attnwarp_eval.study.probe_report import reports
from attnwarp_eval.study.probes.editing.result import EditResult
from attnwarp_eval.study.shared.edit_truth import Judgement

DONE = Judgement("red", True, 25.0, 10.0, 10.0)


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    folder = written_runs.unpack_stored(tmp_path_factory.mktemp("compare"))
    write_baseline(folder / "baseline.jsonl", read_snapshot(Store(folder / "variants")))
    return folder


@pytest.fixture
def run(stored, tmp_path):
    shutil.copytree(stored / "variants", tmp_path / "run")
    return tmp_path / "run"


def gate(*arguments):
    return CliRunner().invoke(app, ["compare", *map(str, arguments)])


def change(run, probe, alter):
    """Alter the record of the first cell of a probe, and seal it again."""
    store = Store(run)
    cell = next(c for c in store.read_study()["cells"] if c["probe"] == probe)
    record = store.read(cell["id"])
    del record["sha256"]
    alter(record)
    store.write(record)


def test_a_run_passes_against_itself_and_its_own_baseline(stored, run):
    for baseline in (stored / "baseline.jsonl", stored / "variants"):
        done = gate(baseline, run)
        assert done.exit_code == 0, done.output
        assert done.stdout.startswith("pass: 0 worse, 0 can't tell, 0 better, ")
    result = compare(read_baseline(stored / "baseline.jsonl"), read_snapshot(Store(run)))
    assert {row.verdict for row in result.rows} == {"equal"}
    # Every gated figure that the records have was read.
    keys = {
        (cell["probe"], variant, key)
        for cell in Store(run).read_study()["cells"]
        for variant in cell["variants"]
        for view in Store(run).read(cell["id"])["views"]
        for key in view["metrics"]
        if gated(key)
    }
    assert {(row.probe, row.variant, row.metric) for row in result.rows} == keys
    assert len(keys) > 20


def add_half_a_pixel(record):
    for view in record["views"]:
        view["metrics"]["warp.epe_median"] += 0.5


def drop_a_metric(record):
    for view in record["views"]:
        del view["metrics"]["warp.epe_median"]


def drop_a_view(record):
    del record["views"][0]


def undefine(record):
    record["views"][0]["metrics"]["warp.epe_median"] = None


def double_a_counter(record):
    record["cost"]["counters"]["pairs"] *= 2


PLANTED = {
    "half a pixel": (add_half_a_pixel, "worse  warp  corrected  warp.epe_median"),
    "a dropped metric": (drop_a_metric, "missing  spheres / warp / corrected / seed 0 / warp.epe"),
    "a dropped view": (drop_a_view, "warp.epe_median / yaw030  the run has no such view"),
    "an undefined value": (undefine, "1 view is undefined now"),
    "a doubled counter": (double_a_counter, "pairs  51328 in the baseline, 102656 in the run"),
}


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_regression_is_exit_code_1_and_named(stored, run, name):
    alter, expected = PLANTED[name]
    change(run, "warp", alter)
    done = gate(stored / "baseline.jsonl", run)
    assert done.exit_code == 1, done.output
    assert expected in done.stdout
    assert done.stdout.splitlines()[-1].startswith("regression: ")
    warned, said = done.stderr.splitlines()
    assert "cells in" in warned and "a regression against" in said


def test_a_run_of_other_code_is_said_to_be_one_in_everything_that_is_written(stored, run, tmp_path):
    """Oracle: records with the hash of another source, and with this code's own."""
    said = f"16 of the 16 cells in {run} were computed by other code than is here"
    files = {name: tmp_path / f"compare.{name}" for name in ("markdown", "html", "json")}
    options = [text for name, path in files.items() for text in (f"--{name}", path)]
    store = Store(run)

    def made_by(environment):
        for cell in store.read_study()["cells"]:
            store.write(store.read(cell["id"]) | {"environment": environment})

    made_by({**environment(), "source": "0" * 64})
    done = gate(stored / "baseline.jsonl", run, *options)
    assert done.exit_code == 0 and said in done.stderr
    for path in files.values():
        assert said in path.read_text()
    made_by(environment())
    done = gate(stored / "baseline.jsonl", run, *options)
    assert done.exit_code == 0 and done.stderr == ""
    assert "notes" not in json.loads(files["json"].read_text())
    done = gate(run, run)
    assert done.exit_code == 2 and "is the baseline too, so nothing can differ" in done.stderr


def test_a_figure_that_is_lost_has_the_value_that_it_had():
    before = {"a": {"v": 1.0, "w": 3.0}, "b": {"v": 6.0}}
    lost = {"a": {"v": math.nan, "w": math.nan}, "b": {"v": math.nan}}
    had, has = _means_of_shared(before, lost)
    assert had == 4.0 and math.isnan(has)
    # Where some views define it on both sides, these are compared.
    assert _means_of_shared(before, {**lost, "a": {"v": 2.0, "w": math.nan}}) == (1.0, 2.0)


@pytest.mark.parametrize("damage", ["removed", "truncated"])
def test_a_dropped_cell_is_a_regression_and_a_damaged_one_is_an_error(stored, run, damage):
    store = Store(run)
    cell = next(c for c in store.read_study()["cells"] if c["probe"] == "depth")
    if damage == "removed":
        store.path(cell["id"]).unlink()
    else:
        store.path(cell["id"]).write_bytes(b"{")
    done = gate(stored / "baseline.jsonl", run)
    if damage == "removed":
        assert done.exit_code == 1
        assert "missing  spheres / depth / corrected / seed 0" in done.stdout
    else:
        assert done.exit_code == 2
        assert done.stderr.count("\n") == 1 and f"{store.path(cell['id'])}: not JSON" in done.stderr
    # An incomplete run is no baseline, neither as a folder nor to be written.
    assert gate(run, stored / "variants").exit_code == 2
    path = run.parent / "new.jsonl"
    assert gate(path, run, "--update").exit_code == (3 if damage == "removed" else 2)
    assert not path.exists()


def test_a_failure_of_a_cell_that_the_study_no_longer_has_is_nobodys(stored, run):
    """A run leaves such a failure if its size or seeds are changed after a cell failed."""
    store = Store(run)
    cell = next(c for c in store.read_study()["cells"] if c["probe"] == "depth")
    about = {"scene": cell["scene"], "variant": cell["variants"][0], "probe": "depth"}
    store.write_failure("0" * 64, {**about, "error": "of another size"})
    assert not read_results(store).failures
    store.path(cell["id"]).unlink()
    told = gate(stored / "baseline.jsonl", run).stdout
    assert "not measured" in told and "of another size" not in told
    store.write_failure(cell["id"], {**about, "error": "of its own"})
    told = gate(stored / "baseline.jsonl", run).stdout
    assert "of its own" in told and "of another size" not in told


def test_figures_of_both_sides_are_of_the_same_views_and_a_single_bad_view_is_told():
    def side(**values):
        figures = {"warp.epe_median": Figure(1, values)}
        return Snapshot("my", "", (Measured("bear", "warp", ("a",), 0, "", {}, figures),))

    # One view got better, one worse, and one is undefined now: the mean of all would have improved.
    (row,) = compare(side(a=1.0, b=8.0, c=9.0), side(a=3.0, b=5.0, c=math.nan)).rows
    assert (row.baseline, row.run, row.difference.mean) == (4.5, 4.0, -0.5)
    assert (row.verdict, row.beyond_margin, row.undefined) == ("worse", 1, 1)
    section = document(compare(side(a=1.0, b=8.0), side(a=3.0, b=5.0))).sections[0]
    assert section.tables[0].rows[0][-1].endswith("(beyond its margin in 1 of 2 views)")


def test_a_cell_that_computes_something_else_is_a_regression(stored, run):
    # Equal figures of another setting (a mask rule lost, another encoder) are no proof of anything.
    baseline = read_baseline(stored / "baseline.jsonl")
    first = next(cell for cell in baseline.cells if cell.probe == "warp")
    other = dataclasses.replace(first, definition=digest("another"))
    cells = tuple(other if cell is first else cell for cell in baseline.cells)
    result = compare(dataclasses.replace(baseline, cells=cells), baseline)
    assert [(f.kind, f.name) for f in result.faults] == [
        ("redefined", "bear / warp / corrected / seed 0")
    ]
    assert result.regressed
    # Nor are they common: a control may be of another scene, if the run has fewer.
    common = compare(dataclasses.replace(baseline, cells=cells), baseline, common=True)
    assert common.left_out[0].startswith("bear / warp / corrected / seed 0 (another scene")
    counted = [sum(row.difference.views for row in one.rows) for one in (common, result)]
    assert not common.faults and 0 < counted[0] < counted[1]


def test_noise_in_seconds_and_memory_never_fails(stored, run):
    generator = np.random.default_rng(1)

    def alter(record):
        cost = record["cost"]
        cost["seconds"] = {k: 1e3 * float(generator.random()) for k in cost["seconds"]}
        cost["peak_memory_mb"] *= 100
        cost["threads"] += 7

    for probe in ("warp", "depth", "fit", "timing", "calibration"):
        change(run, probe, alter)
    assert gate(stored / "baseline.jsonl", run).exit_code == 0
    assert "seconds" not in (stored / "baseline.jsonl").read_text()


def test_an_added_cell_passes_and_is_named(stored):
    whole = read_baseline(stored / "baseline.jsonl")
    part = dataclasses.replace(whole, cells=whole.cells[1:])
    result = compare(part, whole)
    first = whole.cells[0]
    assert result.added == (f"{first.scene} / {first.probe} / {first.variants[0]} / seed 0",)
    assert not result.regressed
    assert compare(whole, part).regressed


@pytest.mark.parametrize(
    ("before", "now", "verdicts"),
    [
        ((70.0, 1e-7), (math.inf, 0.0), {"mse": "equal"}),
        ((math.inf, 0.0), (20.0, 1e-2), {"mse": "worse"}),
        ((30.0, None), (20.0, None), {"psnr": "worse"}),  # without its error it stands for itself
    ],
)
def test_an_error_that_falls_to_0_is_no_regression(before, now, verdicts):
    def measured(psnr, mse):
        values = {"psnr": psnr, "mse": mse}
        figures = {
            f"fidelity.preserved_{name}.edit": Figure(1, {"red/yaw030": shortened(value)})
            for name, value in values.items()
            if value is not None
        }
        return Snapshot("my", "", (Measured("bear", "editing", ("a",), 0, "", {}, figures),))

    result = compare(measured(*before), measured(*now))
    assert {
        row.metric.split("_")[1].removesuffix(".edit"): row.verdict for row in result.rows
    } == verdicts
    assert result.faults == () and result.regressed == ("worse" in verdicts.values())


def test_what_is_written_never_replaces_the_baseline_or_each_other(stored, run, tmp_path):
    path = tmp_path / "baseline.jsonl"
    shutil.copy(stored / "baseline.jsonl", path)
    other = str(tmp_path / "summary")
    (run / "report.html").write_text("its report")
    study = (run / "study.json").read_bytes()
    for arguments, message in (
        (("--json", path), "is the baseline"),
        (("--markdown", path), "is the baseline"),
        (("--json", run / "study.json"), f"is a file of the run {run}"),
        (("--html", run / "report.html"), f"is a file of the run {run}"),
        (("--json", run / "cells" / "ab" / "x.json"), f"lies among the cells of the run {run}"),
        (("--html", run / "pictures" / "x.html"), f"lies among the pictures of the run {run}"),
        (("--json", other, "--html", other), "is that of --json too"),
        (("--update", "--markdown", other), "--markdown: --update compares nothing"),
    ):
        done = gate(path, run, *arguments)
        assert done.exit_code == 2 and message in done.stderr and done.stderr.count("\n") == 1
    assert path.read_bytes() == (stored / "baseline.jsonl").read_bytes()
    assert (run / "study.json").read_bytes() == study
    assert (run / "report.html").read_text() == "its report"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["baseline.jsonl", "run"]


def test_update_says_what_changed_and_then_the_run_passes(stored, run, tmp_path):
    path = tmp_path / "baseline.jsonl"
    shutil.copy(stored / "baseline.jsonl", path)
    change(run, "warp", add_half_a_pixel)
    assert gate(path, run).exit_code == 1
    done = gate(path, run, "--update")
    assert done.exit_code == 0, done.output
    assert "worse  warp  corrected  warp.epe_median" in done.stdout
    assert "1 are new or changed, 1 are gone or changed" in done.stdout
    assert gate(path, run).exit_code == 0
    assert gate(path, stored / "variants").exit_code == 0  # half a pixel better
    before, now = (p.read_text().splitlines() for p in (stored / "baseline.jsonl", path))
    # The first line holds the checksum; one other differs.
    assert sum(a != b for a, b in zip(before, now, strict=True)) == 2
    bytes_of_the_run = path.read_bytes()
    gate(path, run, "--update")
    assert path.read_bytes() == bytes_of_the_run


def test_a_baseline_is_sorted_small_and_holds_what_was_measured(stored):
    lines = (stored / "baseline.jsonl").read_text().splitlines()
    header, *rows = map(json.loads, lines)
    assert header["study"] == "stored" and header["lines"] == len(rows)
    keys = [(r["scene"], r["probe"], r["variants"], r["seed"], r.get("metric", "")) for r in rows]
    assert keys == sorted(keys) and len({json.dumps(key) for key in keys}) == len(keys)
    store = Store(stored / "variants")
    cells = {(c["scene"], c["probe"], tuple(c["variants"])): c for c in store.read_study()["cells"]}
    for row in rows:
        record = store.read(cells[row["scene"], row["probe"], tuple(row["variants"])]["id"])
        if "counters" in row:
            assert row["counters"] == record["cost"]["counters"]
            continue
        values = {
            view["view"]: view["metrics"][row["metric"]]
            for view in record["views"]
            if row["metric"] in view["metrics"]
        }
        assert row["values"].keys() == values.keys()
        for view, value in values.items():
            written = row["values"][view]
            assert written == (None if value is None else pytest.approx(value, rel=1e-8))
    assert (stored / "baseline.jsonl").stat().st_size < 64_000


def malformed(text):
    lines = text.splitlines(keepends=True)
    number = next(i for i, line in enumerate(lines) if '"metric":"depth.abs_rel"' in line)
    edited = [*lines]
    edited[number] = lines[number].replace('"version":1', '"version":2')
    return {
        "empty": "",
        "truncated": text[: len(text) // 2],
        "an edited value": "".join(edited),
        "another study's name": text.replace('"study":"stored"', '"study":"quick"', 1),
        "no object": "[]\n",
        "another layout": text.replace('"baseline":1', '"baseline":9', 1),
        "bytes": "\ud800",
    }


@pytest.mark.parametrize("name", malformed('{"metric":"depth.abs_rel"}\n' * 4))
def test_a_malformed_baseline_is_one_line_and_exit_code_2(stored, tmp_path, name):
    text = malformed((stored / "baseline.jsonl").read_text())[name]
    path = tmp_path / "baseline.jsonl"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    for arguments in ([], ["--update"]):  # what may be somebody's file is never overwritten
        done = gate(path, stored / "variants", *arguments)
        assert (done.exit_code, done.stdout) == (2, ""), done.output
        assert done.stderr.count("\n") == 1 and str(path) in done.stderr
    assert path.read_bytes() == text.encode("utf-8", "surrogatepass")


def test_missing_files_and_runs_of_other_studies_are_exit_code_2(stored, tmp_path):
    other = tmp_path / "other.jsonl"
    write_baseline(
        other, dataclasses.replace(read_snapshot(Store(stored / "variants")), study="other")
    )
    for arguments, message in (
        ((tmp_path / "none.jsonl", stored / "variants"), "no such baseline"),
        ((stored / "baseline.jsonl", tmp_path), "not a run's folder"),
        ((other, stored / "variants"), "expected 'stored' as the run's"),
        ((other, stored / "variants", "--update"), "a baseline of study"),
        ((stored / "variants", stored / "variants", "--update"), "a folder"),
    ):
        done = gate(*arguments)
        assert done.exit_code == 2 and done.stderr.count("\n") == 1, done.output
        assert message in done.stderr


def more(stored, folder, **parts):
    """A baseline of the stored run that also has its cells under other names, and their number."""
    trusted = read_snapshot(Store(stored / "variants"))
    ((key, names),) = parts.items()
    renamed = [
        dataclasses.replace(cell, **{key: (name,) if key == "variants" else name})
        for name in names
        for cell in trusted.cells
        if cell.probe != "calibration" or key != "variants"
    ]
    cells = {cell.key: cell for cell in renamed}
    both = tuple(sorted((*trusted.cells, *cells.values()), key=lambda cell: cell.key))
    path = folder / "more.jsonl"
    write_baseline(path, dataclasses.replace(trusted, cells=both))
    return path, sum(len(cell.variants) for cell in cells.values())


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        ({"scene": ["stump", "garden"]}, "scenes garden, stump"),
        ({"variants": ["blurred", "sharp"]}, "variants blurred, sharp"),
    ],
)
def test_scenes_and_variants_that_a_run_lacks_are_told_in_one_line(stored, tmp_path, parts, told):
    baseline, cells = more(stored, tmp_path, **parts)
    done = gate(baseline, stored / "variants")
    assert done.exit_code == 1
    first, second, last = done.stdout.splitlines()
    assert (first, second) == (
        "Missing or changed:",
        f"  unmeasured  {told}  {cells} cells not in the run's study",
    )
    assert (
        last.startswith("the run lacks some of the baseline: 0 worse, ")
        and "regression" not in done.output
    )
    assert f"lacks {told}, which {baseline} has" in done.stderr and "--common" in done.stderr


@pytest.mark.parametrize(
    "parts", [{"scene": ["garden"]}, {"variants": ["blurred"]}, {"seed": [5, 6]}]
)
def test_what_both_have_is_compared_alone_and_the_rest_is_said(stored, run, tmp_path, parts):
    baseline, _ = more(stored, tmp_path, **parts)
    (names,) = parts.values()
    data = tmp_path / "compare.json"
    done = gate(baseline, run, "--common", "--json", data)
    assert done.exit_code == 3 and "of what both have: 0 worse" in done.stdout, done.output
    (left_out,) = json.loads(data.read_text())["left_out"]
    assert all(str(name) in left_out for name in names)
    assert left_out in done.stdout
    # The figures are those of the comparison with a baseline that has nothing else.
    assert (
        json.loads(data.read_text())["rows"] == json.loads(data_of(stored, run, tmp_path))["rows"]
    )
    change(run, "warp", add_half_a_pixel)
    assert gate(baseline, run, "--common").exit_code == 1  # worse in what both have
    # Nothing is left out of equal sides.
    assert gate(stored / "baseline.jsonl", stored / "variants", "--common").exit_code == 0
    assert gate(baseline, run, "--common", "--update").exit_code == 2


def data_of(stored, run, folder):
    path = folder / "whole.json"
    assert gate(stored / "baseline.jsonl", run, "--json", path).exit_code == 0
    return path.read_text()


def test_what_only_the_run_has_is_left_out_of_what_both_have(stored, tmp_path):
    trusted = read_snapshot(Store(stored / "variants"))
    cells = [cell for cell in trusted.cells if cell.probe != "warp"]
    path = tmp_path / "less.jsonl"
    write_baseline(path, dataclasses.replace(trusted, cells=tuple(cells)))
    done = gate(path, stored / "variants", "--common")
    assert done.exit_code == 3 and "probe warp (only in the run)" in done.stdout
    # An unfinished run is no baseline, but what it has can be compared.
    unfinished = tmp_path / "unfinished"
    shutil.copytree(stored / "variants", unfinished)
    store = Store(unfinished)
    for cell in store.read_study()["cells"]:
        if cell["probe"] == "depth":
            next(store.cells.rglob(f"{cell['id']}*.json")).unlink()
    assert gate(unfinished, stored / "variants").exit_code == 2
    done = gate(unfinished, stored / "variants", "--common")
    assert done.exit_code == 3 and "probe depth (only in the run)" in done.stdout
    done = gate(stored / "variants", unfinished, "--common")
    assert done.exit_code == 3 and "not measured" in done.stdout


def test_markdown_and_json_hold_the_verdicts(stored, run, tmp_path):
    change(run, "warp", add_half_a_pixel)
    markdown, data = tmp_path / "a" / "summary.md", tmp_path / "compare.json"
    done = gate(stored / "baseline.jsonl", run, "--markdown", markdown, "--json", data)
    assert done.exit_code == 1
    assert "| worse | warp | corrected | warp.epe_median |" in markdown.read_text()
    result = json.loads(data.read_text())
    assert result["regressed"] is True and result["faults"] == []
    (row,) = [row for row in result["rows"] if row["verdict"] == "worse"]
    name, before, now = row["worst"]
    assert name.startswith("spheres/") and now - before == pytest.approx(0.5)


METRIC_NAMES = ("depth.abs_rel", "warp.below_1px", "depth.bias_relative", "occlusion.precision")


def samples(seed, noise, shift=0.0, seeds=range(3), scenes=10, hole=False):
    """Three seeds of every scene; views share their scene's noise, and scenes differ widely."""
    generator = np.random.default_rng(seed)
    truth = np.random.default_rng(7).uniform(0.2, 0.8, (scenes, len(METRIC_NAMES)))
    cells = []
    for scene in range(scenes):
        for number in seeds:
            figures = {}
            for j, key in enumerate(METRIC_NAMES):
                sign = -1 if METRICS[key].direction == "higher" else 1
                common = truth[scene, j] + noise * generator.standard_normal() + sign * shift
                values = common + 0.3 * noise * generator.standard_normal(4)
                values[0] = math.nan if hole else values[0]
                figures[key] = Figure(1, {f"yaw{i}": float(v) for i, v in enumerate(values)})
            name = f"scene{scene}"
            cells.append(Measured(name, "depth", ("a",), number, "same", {"n": number}, figures))
    return Snapshot("noise", "", tuple(cells))


@pytest.mark.parametrize(
    ("shift", "scenes", "hole", "verdict"),
    [
        (0.0, 10, False, "equal"),  # the whole interval is within the margin
        (0.0, 10, True, "can't tell"),  # but a view of each scene is undefined
        (2e-3, 6, False, "worse"),
        (-2e-3, 6, False, "better"),
        (2e-3, 5, False, "can't tell"),
    ],
)
def test_changes_of_shares_beyond_rounding_and_within_the_margin_are_tested_over_scenes(
    shift, scenes, hole, verdict
):
    """Rounding of a share is 1e-4, its margin 5e-3."""
    before, now = (samples(k, 1e-4, s, range(3), scenes, hole) for k, s in ((1, 0.0), (2, shift)))
    shares = [row for row in compare(before, now).rows if METRICS[row.metric].unit == "share"]
    assert [row.verdict for row in shares] == [verdict] * 2


def test_corrected_p_values_are_scipys():
    before, now = samples(1, 0.1), samples(2, 0.1, shift=0.05)
    rows = compare(before, now).rows

    def by_scene(side, key):
        table = {}
        for cell in side.cells:
            values = list(cell.figures[key].values.values())
            table.setdefault(cell.scene, []).extend(np.abs(values))
        return np.array([np.mean(values) for _, values in sorted(table.items())])

    p = [
        stats.ttest_rel(by_scene(now, row.metric), by_scene(before, row.metric)).pvalue
        for row in rows
    ]
    expected = stats.false_discovery_control(p, method="bh")
    np.testing.assert_allclose([row.adjusted_p for row in rows], expected, rtol=1e-9)
    assert min(p) < 0.05


def test_other_seeds_are_other_cells():
    result = compare(samples(1, 0.1), samples(1, 0.1, seeds=range(2, 5)))
    (fault,) = result.faults
    assert (fault.kind, fault.name) == ("unmeasured", "seeds 0, 1")
    assert {row.difference.views for row in result.rows} == {10 * 4}  # of the seed 2
    assert compare(samples(1, 0.1), samples(1, 0.1, seeds=(7,))).too_little


def test_counts_of_each_edit_of_a_scene_are_compared():
    def side(*rows):
        return Snapshot("my", "", tuple(
            Measured("ball", "editing", ("a",), 0, name, {"network_rows": count}, {})
            for name, count in zip("ab", rows, strict=True)
        ))  # fmt: skip

    assert compare(side(5, 8), side(5, 8)).faults == ()
    (fault,) = compare(side(5, 8), side(5, 16)).faults
    assert fault.kind == "counter" and fault.detail.startswith("13 in the baseline, 21 in the run")


def test_nothing_in_common_is_exit_code_3(stored, tmp_path):
    run = stored / "variants"
    whole = read_snapshot(Store(run))
    empty = dataclasses.replace(whole, cells=())
    write_baseline(tmp_path / "empty.jsonl", empty)
    done = gate(tmp_path / "empty.jsonl", run)
    assert done.exit_code == 3 and "share no gated figure" in done.stderr


EDITED = {
    "multiview.same_answer.edit": 1.0,
    "multiview.same_answer.edit_seen": 1.0,
    "multiview.delta_e_above.edit_inside": 2.0,
    "multiview.delta_e_above.edit_next": -1.0,
    "multiview.delta_e_above.render_inside": 3.0,
    "fidelity.mse.edit_inside": 0.01,
    "fidelity.mse.render_inside": 0.02,
    "fidelity.preserved_psnr.edit": 40.0,
    "embedding.clip_directional.render": 0.2,
    "embedding.dino_image.render": 0.9,
    "image.psnr.edit_render": 30.0,
    "depth.abs_rel.after": 0.01,
}


def edited(figures, probe="editing"):
    """A calibrated run of one edit of one scene."""
    study = {"name": "edits", "scenes": ["ball"], "seeds": [1, 2], "variants": {"ours": {}},
             "probes": {probe: ["ours"]}}  # fmt: skip
    extra = {
        "editing": EditResult("red", "make it red", DONE, DONE, {}, {}, 30.0, 2, 1.0),
        "chord": Longest("yaw015", 1.0),
    }[probe].to_json()
    cells = [
        written_runs.outcome("calibration", "ball", ["calibration"], written_runs.record(
            [("yaw015", 15.0, {"warp.epe_median": 0.1})])),
        written_runs.outcome(probe, "ball", ["ours"], written_runs.record(
            [("red/yaw015", 15.0, figures)], **extra)),
    ]  # fmt: skip
    return snapshot(written_runs.results(study, cells))


def test_an_edit_that_got_worse_in_any_figure_is_a_regression():
    before = edited(EDITED)
    assert not compare(before, before).regressed
    for key, value in EDITED.items():
        sign = -1 if METRICS[key].direction == "higher" else 1
        result = compare(before, edited(EDITED | {key: value + sign * max(0.1, 0.1 * abs(value))}))
        worse = [(row.probe, row.metric) for row in result.rows if row.verdict == "worse"]
        assert worse == [("editing", key)] and result.regressed
        left = {k: v for k, v in EDITED.items() if k != key}
        (fault,) = compare(before, edited(left)).faults
        assert (fault.kind, fault.name) == ("missing", f"ball / editing / ours / seed 0 / {key}")


def test_a_probe_of_which_nothing_was_compared_is_too_little():
    side = edited({"multiview.pixels": 3.0})  # a count has no better direction
    result = compare(side, side)
    assert result.rows and not result.regressed
    assert result.too_little.startswith("both sides share no gated figure of 'editing'")
    assert summary(result).startswith("too little to compare: 0 worse")
    assert not compare(edited(EDITED), edited(EDITED)).too_little


def test_a_probe_of_ones_own_that_no_gate_knows_does_not_stop_a_comparison():
    register(Chord)
    try:
        result = compare(*(edited({"chord.length": length}, "chord") for length in (1.0, 2.0)))
    finally:
        unregister("chord")
    assert result.rows and not result.too_little and not result.regressed


STANDS_IN = {
    "depth.rmse": "depth.abs_rel",
    "depth.bias_median": "depth.bias_relative",
    "depth.delta_1_25": "depth.delta_1_01",
    "occlusion.f1": "occlusion.precision",
    "fit.psnr": "fit.mse",
}
"""Headline figures that move with a gated one of the same pixels."""


def headlines(report):
    for key in (*report.columns.values(), *report.contrasts):
        whole = key.format(layer=64).removesuffix(".interior").removesuffix(".edge")
        yield STANDS_IN.get(whole, whole.replace("fidelity.psnr.", "fidelity.mse."))


def test_every_headline_figure_is_gated_and_every_gate_is_a_figure_of_a_probe(stored):
    keys = {key for report in reports() for key in headlines(report)}
    assert len(keys) > 20
    assert [key for key in keys if not gated(key)] == []
    keys |= {
        key
        for cell in Store(stored / "variants").done()
        for view in Store(stored / "variants").read(cell)["views"]
        for key in view["metrics"]
    }
    # Claims and the tests of these probes read the rest.
    elsewhere = {
        "fidelity.ssim", "fidelity.preserved_mse", "fidelity.preserved_psnr",
        "embedding.clip_similarity", "stability.margin",
    }  # fmt: skip
    assert GATES.keys() - {METRICS[key].name for key in keys if gated(key)} == elsewhere


def test_every_gate_is_a_registered_metric_with_a_direction_and_a_wider_margin():
    for name, margin in GATES.items():
        metric = METRICS[name]
        assert metric.direction != "none" and metric.name == name
        for value in (0.0, 0.01, 1.0):
            assert margin.around(value) >= metric.atol + metric.rtol * value
