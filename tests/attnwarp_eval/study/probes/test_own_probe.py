"""A probe of the tests' own runs from a study's YAML to the report, and no other file names it.

Oracles: the chord of two cameras on an orbit by the law of cosines; byte equality of reports.
"""

import ast
import json
import math
import pathlib

import numpy as np
import pytest
import yaml
from chord_probe import Chord

import attnwarp_eval
from attnwarp_eval.report import write_report
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import Store, StudyError, load_study
from attnwarp_eval.study.probe import probes, register, unregister
from attnwarp_eval.study.run import execute, plan, verify
from attnwarp_eval.study.work import compute

YAWS = (30, 90)
STUDY = {
    "name": "own",
    "size": 16,
    "scenes": ["spheres"],
    "views": [f"yaw{yaw:03d}" for yaw in YAWS],
    "spp": 1,
    "camera_unit": 2.0,
    "variants": {"plain": {}, "same": {}, "double": {"stretch": 2.0}},
    "probes": {"chord": ["plain", "same", "double"]},
    "ablations": [
        {"title": "Stretch", "probe": "chord", "baseline": "plain", "variants": ["double"]}
    ],
    "pictures": {"variants": ["double"], "views": ["yaw090"]},
}


@pytest.fixture(autouse=True)
def own_probe():
    register(Chord)
    yield
    unregister("chord")


def load(folder, **changes):
    (folder / "own.yaml").write_text(yaml.safe_dump({**STUDY, **changes}))
    return load_study(str(folder / "own.yaml"))


def chord(yaw):
    """Distance of the source camera and a target, in scene units, by the law of cosines."""
    cameras = load_scene("spheres").spec.cameras
    target = next(t for t in cameras.targets if abs(t.yaw - cameras.source.yaw) == yaw)
    across = 2 * cameras.radius**2 * (1 - math.cos(math.radians(yaw)))
    return math.sqrt(across + (target.height - cameras.source.height) ** 2)


def test_a_probe_in_one_file_runs_through_study_store_resume_and_report(tmp_path):
    study, store = load(tmp_path), Store(tmp_path / "run")
    planned = plan(study, store)
    assert [(c.probe, c.labels) for c in planned.cells] == [
        ("calibration", ("calibration",)),
        ("chord", ("plain", "same")),
        ("chord", ("double",)),
    ]
    summary = execute(planned, store)
    assert summary.complete, summary.failures
    plain, double = (store.read(cell.id) for cell in planned.cells[1:])
    for record, stretch in ((plain, 1), (double, 2)):
        expected = [stretch * chord(yaw) / 2 for yaw in YAWS]
        chords = [view["metrics"]["chord.length"] for view in record["views"]]
        assert chords == pytest.approx(expected, rel=1e-12)
        assert record["longest"] == {"target": "yaw090", "chord": pytest.approx(expected[1])}
    assert [p["what"] for p in double["pictures"]] == ["grey"]
    assert verify(store).ok

    write_report(store, timings=False)
    names = ("report.md", "report.html", "results.jsonl")
    before = {name: (store.root / name).read_bytes() for name in names}
    text = before["report.md"].decode()
    assert "**Stretch**" in text and "## Longest chords" in text
    assert f"| double | yaw090 | {chord(90):.3g}" in text
    assert (
        b"data:image/jpeg" in before["report.html"]
        and "distance of target and source camera" in text
    )
    lines = [json.loads(line) for line in before["results.jsonl"].splitlines()]
    assert {line["also"][0] for line in lines if line["variant"] == "plain"} == {"same"}

    store.path(planned.cells[2].id).unlink()
    resumed = plan(study, store)
    assert [cell.labels for cell in resumed.todo] == [("double",)]
    assert execute(resumed, store).complete
    write_report(store, timings=False)
    assert {name: (store.root / name).read_bytes() for name in names} == before


def test_a_probe_without_a_report_is_shown_by_a_table_of_its_metrics(tmp_path):
    class Bare(Chord):
        name = "bare"

    unregister("chord")
    register(Bare)
    try:
        tables = [{**STUDY["ablations"][0], "probe": "bare"}]
        study = load(tmp_path, probes={"bare": ["plain", "double"]}, ablations=tables,
                     variants={name: STUDY["variants"][name] for name in ("plain", "double")})  # fmt: skip
        store = Store(tmp_path / "run")
        assert execute(plan(study, store), store).complete
        write_report(store, timings=False)
    finally:
        unregister("bare")
    text = (store.root / "report.md").read_text()
    mean = sum(map(chord, YAWS)) / len(YAWS) / 2
    rows = f"| variant | chord.length |\n|---|---|\n| plain | {mean:.3g} |\n| double | {2 * mean:.3g} |"
    assert f"## Figures of bare\n\n{rows}" in text
    assert f"**Stretch**\n\n{rows}" in text


@pytest.mark.skipif(not pathlib.Path("/proc/self/clear_refs").exists(), reason="not Linux")
def test_a_cells_peak_memory_leaves_out_what_an_earlier_cell_had_freed(tmp_path, monkeypatch):
    """Oracle: the array that the first cell held."""
    measured = Chord.compute

    def hungry(self, work):
        if work.cell.labels[0] == "plain":
            np.ones(2**26)  # 512 MiB, which go back to the system
        return measured(self, work)

    monkeypatch.setattr(Chord, "compute", hungry)
    _, *cells = plan(load(tmp_path), Store(tmp_path / "run")).cells
    first, second = (compute(Chord(), cell, tmp_path).cost.peak_memory_mb for cell in cells)
    assert 450 < first - second < 600


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_unit": -1.0}, "camera_unit: expected a positive number"),
        (
            {"camera_units": 1.0},
            "camera_units: unknown key 'camera_units'; did you mean 'camera_unit'",
        ),
        ({"variants": {"plain": {"stretch": 0}}}, "variants.plain.stretch: .*greater than 0"),
        ({"probes": {"chor": []}}, "probes: no probe 'chor'; did you mean 'chord'"),
    ],
)
def test_its_part_of_the_yaml_is_checked_as_any_other(tmp_path, changes, message):
    with pytest.raises(StudyError, match=message):
        load(tmp_path, **changes)


def test_without_it_its_keys_are_unknown(tmp_path):
    unregister("chord")
    with pytest.raises(StudyError, match="camera_unit: unknown key"):
        load(tmp_path)


def test_a_figure_that_its_metrics_do_not_specify_costs_the_cell(tmp_path, monkeypatch):
    store = Store(tmp_path / "run")
    planned = plan(load(tmp_path), store)
    monkeypatch.setattr(Chord, "metrics", {})
    summary = execute(planned, store)
    assert [failure.probe for failure in summary.failures] == ["chord", "chord"]
    assert "gives 'chord.length', which its metrics do not specify" in summary.failures[0].error


@pytest.mark.door
def test_two_probes_of_one_name_are_refused():
    class Other(Chord):
        pass

    with pytest.raises(ValueError, match="probe 'chord': Chord has that name already"):
        register(Other)


def test_study_runner_store_report_and_command_line_name_no_probe():
    root = pathlib.Path(attnwarp_eval.__file__).parent
    files = [
        # Two read the study's key editing.edits, which names edits by scene.
        *(path for path in root.glob("study/*.py") if path.name != "populations.py"),
        *(path for path in root.glob("report/*.py") if path.name != "raw.py"),
        # One command is that of a study and of its probe, and main names it; another asks for
        # NVIDIA's package warp.
        *(p for p in root.glob("cli/*.py") if p.stem not in ("stability", "main", "machine")),
    ]
    assert len(files) > 20
    names = {probe.name for probe in probes()}
    assert len(names) > 10
    for path in files:
        constants = {
            node.value for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        }  # fmt: skip
        assert not constants & names, path
