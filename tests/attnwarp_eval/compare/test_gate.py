"""The gate of this repository: its committed baseline, regressions planted in the code, and runs of
equal code. Oracle: what was planted.
"""

import dataclasses
import json
import pathlib

import pytest
from typer.testing import CliRunner

from attnwarp.fit import loop as fit_loop
from attnwarp.methods import tuning
from attnwarp.methods.algorithms.attention_warping import AttentionWarping
from attnwarp.render import render
from attnwarp_eval.cli.main import app
from attnwarp_eval.compare import compare, read_baseline, read_snapshot
from attnwarp_eval.compare.pictures import pictures_of_baseline
from attnwarp_eval.compare.snapshot import definition
from attnwarp_eval.study import Store, load_study
from attnwarp_eval.study.probes.depth import measure as depth
from attnwarp_eval.study.run import execute, plan
from attnwarp_eval.study.shared import warps

BASELINE = pathlib.Path(__file__).parents[3] / "reports" / "baseline" / "gate.jsonl"


def test_the_committed_baseline_is_of_todays_gate_study():
    # A changed protocol, scene or study asks for `make baseline`; this tells so before the gate runs.
    baseline = read_baseline(BASELINE)
    cells = plan(load_study("gate"), Store("none")).cells
    assert {
        (cell.scene, cell.probe, cell.labels, cell.seed, definition(cell.spec)) for cell in cells
    } == {
        (cell.scene, cell.probe, cell.variants, cell.seed, cell.definition)
        for cell in baseline.cells
    }
    # A person can read the difference of two, and pictures show what changed.
    assert BASELINE.stat().st_size < 64_000
    pictures = pictures_of_baseline(BASELINE, baseline)
    assert {view for _, _, view in pictures} == {"yaw060"}
    assert all(file.is_file() for files in pictures.values() for file in files.values())


def run_study(study, root):
    store = Store(root)
    return execute(plan(study, store), store), store


def gate_study():
    """Gate of one scene, whose world stays in memory from run to run."""
    return load_study("gate", scenes=["spheres"])


@pytest.fixture(scope="module")
def trusted(tmp_path_factory):
    summary, store = run_study(gate_study(), tmp_path_factory.mktemp("gate") / "trusted")
    assert summary.complete
    return store


def half_a_pixel(patch):
    def shifted(*arguments, **options):
        view = warp_view(*arguments, **options)
        moved = dataclasses.replace(view.correspondence, xy=view.correspondence.xy + 0.5)
        return dataclasses.replace(view, correspondence=moved)

    warp_view = warps.warp_view
    patch.setattr(warps, "warp_view", shifted)


def one_percent_in_depth(patch):
    def scaled(*arguments):
        surface = render_surface(*arguments)
        return dataclasses.replace(surface, depth=1.01 * surface.depth)

    render_surface = depth.render_surface
    patch.setattr(depth, "render_surface", scaled)


def a_mask_rule_lost(patch):
    def lax(model, source, target, settings, **options):
        without = dataclasses.replace(settings, depth_agreement=False)
        return warp_view(model, source, target, without, **options)

    warp_view = warps.warp_view
    patch.setattr(warps, "warp_view", lax)


def a_repeated_edit(patch):
    def twice(*arguments):
        edit_targets(*arguments)
        return edit_targets(*arguments)

    edit_targets = AttentionWarping.edit_targets
    patch.setattr(AttentionWarping, "edit_targets", twice)


def each_step_rendered_twice(patch):
    for module in (tuning, fit_loop):
        patch.setattr(module, "render", lambda *a, **k: (render(*a, **k), render(*a, **k))[0])


FOUND = {
    half_a_pixel: ("worse", "warp / corrected / warp.epe_median"),
    one_percent_in_depth: ("worse", "depth / corrected / depth.abs_rel"),
    a_mask_rule_lost: ("worse", "warp / corrected / occlusion.precision"),
    a_repeated_edit: ("counter", "spheres / ideal / corrected / seed 0 / network_rows"),
    each_step_rendered_twice: ("counter", "spheres / ideal / corrected / seed 0 / rendered_pairs"),
}


@pytest.mark.slow
@pytest.mark.parametrize("planted", FOUND, ids=lambda planted: planted.__name__)
def test_a_regression_in_the_code_is_found(trusted, planted, tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        planted(patch)
        _, store = run_study(gate_study(), tmp_path / "run")
    html, data = tmp_path / "compare.html", tmp_path / "compare.json"
    done = CliRunner().invoke(
        app, ["compare", *map(str, (trusted.root, store.root, "--html", html, "--json", data))]
    )
    assert done.exit_code == 1, done.output
    result = json.loads(data.read_text())
    named = {(fault["kind"], fault["name"]) for fault in result["faults"]}
    named |= {
        (row["verdict"], f"{row['probe']} / {row['variant']} / {row['metric']}")
        for row in result["rows"]
    }
    assert FOUND[planted] in named
    if planted is each_step_rendered_twice:
        assert ("counter", "spheres / fit / 2DGS fit / seed 0 / rendered_pairs") in named
    # What moved is shown before and after.
    moved = planted in (half_a_pixel, one_percent_in_depth, a_mask_rule_lost)
    assert ('class="slider"' in html.read_text()) == moved


@pytest.mark.slow
def test_equal_code_passes_and_its_seconds_are_not_looked_at(trusted, tmp_path):
    _, store = run_study(gate_study(), tmp_path / "run")
    seconds = [
        store.read(cell)["cost"]["seconds"] != trusted.read(cell)["cost"]["seconds"]
        for cell in trusted.done()
    ]
    assert all(seconds)
    result = compare(read_snapshot(trusted), read_snapshot(store))
    assert not result.regressed
    assert {row.verdict for row in result.rows} == {"equal"}
