"""Oracles: figures put in by hand, whose means and paired differences are known."""

import json
import lzma
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from attnwarp.errors import InputError
from attnwarp.io import read_image
from attnwarp.io.lock import alone_in
from attnwarp_eval.bench import EDITORS, result, run, score, suite
from attnwarp_eval.cli.main import app
from attnwarp_eval.plugins import load_plugins
from attnwarp_eval.truth.mitsuba import build

REPORTS = Path(__file__).parents[3] / "reports" / "bench"
BENCH = {"generator": 1, "seed": 31, "size": 64, "spp": 4, "views": ["source"]}


def made(name, errors, track=result.SAME, apart=1.0, **other):
    """A result whose scenes have these errors, and one figure undefined."""
    figures = dict.fromkeys(result.FIGURES, 0.5) | {"drift": None}
    aparts = apart if isinstance(apart, list) else [apart] * len(errors)
    scores = [
        {"scene": f"drawn-{k}", "edit": "colour", "by_view": {"yaw010": {"x": None}},
         "figures": figures | {"error": error, "apart": aparts[k]}, "remarks": []}
        for k, error in enumerate(errors)
    ]  # fmt: skip
    method = {"name": name, "editor": "small-plain", "track": track}
    return {
        "protocol": 3,
        "bench": BENCH,
        "method": method,
        "scores": scores,
        "missing": [],
    } | other


def read(tmp_path, data):
    path = tmp_path / "one.json"
    path.write_text(json.dumps(data))
    return result.Result.read(path)


@pytest.mark.parametrize("path", sorted(REPORTS.glob("*.json.xz")), ids=lambda path: path.stem)
def test_every_result_of_the_table_has_the_format_and_one_bench(path):
    one, first = (result.Result.read(p) for p in (path, min(REPORTS.glob("*.json.xz"))))
    assert one.bench == first.bench and one.method.name
    assert lzma.decompress(path.read_bytes()).decode() == written(one, path.parent / "never.json")


def test_a_compressed_result_that_was_cut_off_is_refused(tmp_path):
    path = tmp_path / "one.json.xz"
    path.write_bytes(min(REPORTS.glob("*.json.xz")).read_bytes()[:5000])
    with pytest.raises(InputError, match=r"one\.json\.xz: is no xz file, or cut off; make it with"):
        result.Result.read(path)


def written(one, path):
    texts = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(result, "write_atomic", lambda _, data: texts.append(data.decode()))
        one.write(path)
    return texts[0]


def test_the_table_is_made_of_the_results_beside_it():
    results = [result.Result.read(path) for path in sorted(REPORTS.glob("*.json.xz"))]
    from attnwarp_eval.document.write import markdown

    assert (REPORTS / "bench.md").read_text() == markdown(result.compare(results))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"protocol": 1}, "protocol: Input should be 3"),
        ({"rank": 1}, "rank: Extra inputs"),
        ({"scores": []}, "scores: List should have at least 1"),
        ({"method": {"track": "fastest"}}, "method.track"),
    ],
)
def test_a_result_of_another_format_is_refused_by_name(tmp_path, change, message):
    with pytest.raises(InputError, match=f"one.json: {message}"):
        read(tmp_path, made("a", [1.0]) | change)


def test_a_result_without_a_figure_is_refused(tmp_path):
    data = made("a", [1.0])
    del data["scores"][0]["figures"]["drift"]
    with pytest.raises(InputError, match="lacks drift"):
        read(tmp_path, data)


def test_methods_are_ordered_by_their_track_and_paired_by_scene(tmp_path):
    ours = read(tmp_path, made("ours", [2.0, 4.0, 3.0] * 2))
    best = read(tmp_path, made("best", [1.0, 2.5, 2.5] * 2))  # 1, 1.5, 0.5 less, twice
    named = read(tmp_path, made("named", [0.1] * 6, result.OWN, [0.0, None] + [0.0] * 4))
    own = read(tmp_path, made("own", [9.0] * 6, result.OWN, -4.5))
    report = result.compare([ours, best, named, own])
    same, other = (section.tables[0].rows for section in report.sections)
    assert [row[0] for row in same] == ["best", "ours"]
    # Student's t of six differences: 2.571 * sqrt(1 / 5) / sqrt(6) = 0.469.
    assert same[0][-1] == "-1.00 [-1.47, -0.53]" and same[1][-1] == ""
    few = [read(tmp_path, made(name, errors)) for name, errors in (("a", [1.0]), ("b", [2.0]))]
    assert result.compare(few).sections[0].tables[0].rows[1][-1] == "+1.00"
    assert same[0][3:7] == ["2.00 [1.19, 2.81]", "1.00 [1.00, 1.00]", "0.50 [0.50, 0.50]", "0.50"]
    assert other[0][4] == "0.00 (1 undefined)"  # five scenes have no interval
    assert [row[0] for row in other] == ["named", "best", "ours", "own"]
    moved = read(tmp_path, made("b", [1.0], bench=BENCH | {"seed": 32}))
    with pytest.raises(InputError, match="another bench"):
        result.compare([ours, moved])


def test_warps_stand_in_a_table_of_their_own_behind_it_those_without_all_scenes(tmp_path):
    def warped(name, wrong, **other):
        data = made(name, wrong, result.WARPS, **other)
        for one in data["scores"]:
            values = dict.fromkeys(result.WARP_FIGURES, 0.5) | {"wrong": one["figures"]["error"]}
            one |= {"edit": result.WARPS, "figures": values}
        return read(tmp_path, data)

    ours, best = warped("ours", [0.2, 0.4, 0.3] * 2), warped("best", [0.1, 0.25, 0.25] * 2)
    few = warped("few", [0.0] * 5)  # scored on a bench of five scenes: nothing is missing
    pictures = read(tmp_path, made("pictures", [2.0] * 6))
    same, warps = result.compare([pictures, ours, best, few]).sections
    assert (same.title, warps.title) == ("Same editor: colour", "Warps")
    assert [row[0] for row in same.tables[0].rows] == ["pictures"]
    (table,) = warps.tables
    assert [row[0] for row in table.rows] == ["best", "ours", "few"]
    assert len(table.columns) == len(table.rows[0]) and "editor" not in table.columns
    # A tenth of the errors that the test above works out.
    assert table.rows[0][-1] == "-0.100 [-0.147, -0.053]"
    data = made("mixed", [1.0])
    data["scores"][0]["edit"] = result.WARPS
    with pytest.raises(InputError, match="lacks wrong"):
        read(tmp_path, data)


def test_our_methods_hand_in_every_view_and_go_on_where_they_were(tmp_path, monkeypatch):
    monkeypatch.setattr(build, "TEXELS", 128)
    load_plugins()
    assert "ideal" in EDITORS
    bench, out = tmp_path / "bench", tmp_path / "out"
    suite.export(bench, count=1, seed=9, size=32, spp=1, targets=1)
    options = {"preset": "extended", "steps": 4, "iterations": 0, "stages": 1}
    told = run.run(bench, out, editor="ideal", options=options)
    assert told.track == result.SAME and told.seconds > 0
    assert (
        told.name == "attention_warping, extended, surface noise"
        and told.settings["decay"] == "by_kind"
    )
    for wrong, said in (
        (["foo"], "one of"),
        (["gaussctrl"], "made for a depth"),
        (["by_view", "--set", "foo=1"], "one of"),
    ):
        call = ["bench", "run", str(bench), str(tmp_path / "no"), "--editor", "small-plain"]
        done = CliRunner().invoke(app, [*call, "--method", *wrong])
        assert done.exit_code == 2 and said in done.stderr
    with alone_in(out):  # another process runs there
        done = CliRunner().invoke(app, ["bench", "run", str(bench), str(out), "--method", "warp"])
    assert done.exit_code == 2 and "another run writes to this folder" in done.stderr
    scores = score.score(bench, out, tmp_path / "score").scores
    (one,) = (s for s in scores if s.edit == "colour")
    # The ideal editor knows the only answer, and leaves the rest alone to the width of a token.
    assert one.figures["done"] == 1 and one.figures["outside"] < 1 and one.remarks == []
    place = out / "drawn-0" / "colour"
    before = read_image(place / "source.png")
    (place / "source.png").unlink()
    run.run(bench, tmp_path / "warps", "warp")
    again = run.run(bench, out, editor="ideal", options=options)
    assert again.seconds > told.seconds
    np.testing.assert_array_equal(read_image(place / "source.png"), before)
    with pytest.raises(InputError, match="another method"):
        run.run(bench, out, "by_view", editor="ideal", options={"steps": 4, "iterations": 0})
    held = json.loads((bench / suite.FILE).read_text())
    (bench / suite.FILE).write_text(json.dumps(held | {"seed": 10}))  # another bench
    for method, place in (("attention_warping", out), ("warp", tmp_path / "warps")):
        with pytest.raises(InputError, match="of another method or bench"):
            run.run(bench, place, method, editor="ideal", options=options if place == out else {})
