"""Two runs that former code computed: today's code verifies them and writes the same reports.

``data/runs.tar.xz`` holds ``variants`` (the probes of variants on two scenes, 24 x 24 px) and
``edits`` (sensitivity, without encoders) as revision 33b7813e6823 wrote them, with its results.jsonl of
``report --no-timings --no-pictures``. The report.md are younger: where the report's words or the rules of its
verdicts are changed on purpose, read the difference and put the new file there. The runs' two scenes said
``bounces: 1``, so today's are given that. Where a protocol is changed on purpose, run the studies in their study.json again and
put the new folders there.
"""

import dataclasses
import json
import pathlib
import shutil
import tarfile

import pytest
import written_runs
from direct_light import direct

from attnwarp.errors import InputError
from attnwarp.warp.settings import PRESETS
from attnwarp_eval.report import write_report
from attnwarp_eval.report.results import read_results
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import Store
from attnwarp_eval.study.probes import probe
from attnwarp_eval.study.probes.base import Layout
from attnwarp_eval.study.run import verify
from attnwarp_eval.study.store import StoreError

DATA = pathlib.Path(__file__).parents[1] / "data" / "runs.tar.xz"


@pytest.fixture(autouse=True)
def scenes_of_direct_light(monkeypatch):
    monkeypatch.setattr("attnwarp_eval.study.run.load_scene", direct)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stored")
    with tarfile.open(DATA) as archive:
        # Python 3.11.3 and before have no filters.
        archive.extraction_filter = getattr(tarfile, "data_filter", None)
        archive.extractall(folder)
    return folder


@pytest.mark.parametrize("name", ["variants", "edits"])
def test_ids_records_and_reports_are_the_bytes_that_they_were(folder, name):
    store = Store(folder / name)
    # The ids follow from the study, the scenes and the protocols of today.
    problems = verify(store)
    assert problems.ok, problems
    assert problems.checked == {"variants": 16, "edits": 2}[name]
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


def test_swapped_labels_are_found_without_a_seal_and_refused_with_one(folder, tmp_path):
    shutil.copytree(folder / "variants", tmp_path / "run")
    store = Store(tmp_path / "run")
    path = store.root / "study.json"
    sealed = json.loads(path.read_text())
    assert "sha256" not in sealed  # of former code
    first, second = [cell for cell in sealed["cells"] if cell["probe"] == "warp"][:2]
    first["variants"], second["variants"] = second["variants"], first["variants"]
    path.write_text(json.dumps(sealed))
    problems = verify(store)
    assert not problems.sealed
    assert len(problems.damaged) == 2
    for line, cell in zip(
        problems.damaged, sorted([first, second], key=lambda c: c["id"]), strict=True
    ):
        assert cell["id"] in line and "is called" in line
    # A checksum that was removed cannot be told from one that former code never wrote.
    with pytest.raises(StoreError, match="is called .* but the study calls it"):
        write_report(store)

    first["variants"], second["variants"] = second["variants"], first["variants"]
    store.write_study(sealed)
    assert verify(store).ok and verify(store).sealed
    text = path.read_text()
    path.write_text(text.replace(first["variants"][0], "better"))
    for command in (verify, write_report):
        with pytest.raises(StoreError, match="checksum does not fit"):
            command(store)


def _no_scene(name):
    raise InputError(f"{name}: no such scene")


def _label(cells, probe, variants):
    next(cell for cell in cells if cell["probe"] == probe)["variants"] = variants


def _swap(cells):
    first, second = [cell for cell in cells if cell["probe"] == "warp"][:2]
    first["variants"], second["variants"] = second["variants"], first["variants"]


def _another_seed(cells):
    cells[0]["seed"] = 1


def _another_scene(cells):
    cells[0]["scene"] = "bear"


@pytest.mark.door
@pytest.mark.parametrize(
    ("load", "damage"),
    [
        # Today's scenes have another light than the run's, so other ids: the rest of a spec tells.
        (load_scene, _swap),
        (load_scene, lambda cells: _label(cells, "calibration", ["calibratiof"])),
        (load_scene, _another_seed),
        # Without the scenes, the records tell.
        (_no_scene, lambda cells: _label(cells, "warp", ["slippee"])),
        (_no_scene, _another_seed),
        (_no_scene, _another_scene),
    ],
)
def test_a_former_run_whose_scenes_have_changed_is_read_and_a_wrong_label_in_it_is_refused(
    folder, tmp_path, monkeypatch, load, damage
):
    monkeypatch.setattr("attnwarp_eval.study.run.load_scene", load)
    shutil.copytree(folder / "variants", tmp_path / "run")
    store = Store(tmp_path / "run")
    assert read_results(store).measured == 16
    path = store.root / "study.json"
    study = json.loads(path.read_text())
    damage(study["cells"])
    path.write_text(json.dumps(study))
    with pytest.raises(StoreError, match=r"study\.json: cell .* (is called|has the variant)"):
        read_results(store)


@pytest.mark.parametrize("load", [direct, load_scene])
def test_a_former_run_is_read_where_a_changed_preset_merges_two_of_its_cells(
    folder, tmp_path, monkeypatch, load
):
    merged = dataclasses.replace(PRESETS["corrected"], pixel_centers="integer")
    monkeypatch.setitem(PRESETS, "corrected", merged)
    monkeypatch.setattr("attnwarp_eval.study.run.load_scene", load)
    shutil.copytree(folder / "variants", tmp_path / "run")
    store = Store(tmp_path / "run")
    path = store.root / "study.json"
    text = path.read_text()
    names = {cell["id"]: tuple(cell["variants"]) for cell in json.loads(text)["cells"]}
    results = read_results(store)
    assert results.measured == 16
    assert {cell.id: cell.variants for cell in results.cells} == names

    # Today both variants have the settings of the records of "slipped". The name of the other is
    # that of another cell in the run.
    def relabelled(variants):
        study = json.loads(text)
        cells = [c for c in study["cells"] if c["probe"] == "warp" and c["scene"] == "spheres"]
        for cell in cells:
            cell["variants"] = variants.get(cell["variants"][0], cell["variants"])
        path.write_text(json.dumps(study))

    for variants in (
        {"slipped": ["corrected"]},
        {"slipped": ["slippee"]},
        {"slipped": ["slipped", "slipped"]},
    ):
        relabelled(variants)
        with pytest.raises(StoreError, match="is called .* but the study calls it"):
            read_results(store)


@pytest.mark.parametrize(("size", "small"), [(255, True), (256, False)])
def test_the_calibration_says_where_the_pictures_are_small(tmp_path, size, small):
    study = {"name": "s", "scenes": ["a"], "size": size, "probes": {"calibration": []}}
    data = written_runs.record([])
    cell = written_runs.outcome("calibration", "a", ["calibration"], data)
    made = probe("calibration").sections(written_runs.results(study, [cell]), Layout(tmp_path))
    (section,) = [section for _, section in made if section.title == "Calibration"]
    words = f"The pictures are small: at {size} px, "
    assert sum(text.startswith(words) for text in section.text) == small
    assert ("The pictures are small" in "".join(section.text)) == small
