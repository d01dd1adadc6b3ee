"""Damaged studies and runs: a right result or one line.

The run is a stored one (``data/runs.tar.xz``), reduced to one scene. A
failure is repeated by its label: the name of the format and the seed of :mod:`damage_files`.
"""

import contextlib
import json

import damage_files
import pytest
import written_runs
import yaml

from attnwarp.errors import InputError
from attnwarp_eval.report.results import read_results
from attnwarp_eval.study import Store, load_study
from attnwarp_eval.study.probe import probe

FAST, SLOW = 12, 150

STUDY = """\
name: small
title: Presets on two scenes
size: 64
scenes: [spheres, bear]
views: [yaw030, yaw150]
feature_sizes: [64, 16]
seeds: [0, 1]
spp: 1
splats: {count: 2000}
variants:
  corrected: {preset: corrected}
  slipped: {preset: corrected, set: {pixel_centers: integer}}
  sparse: {preset: corrected, splats: {count: 500}}
probes:
  depth: [corrected, sparse]
  warp: [corrected, slipped]
  timing: [corrected, slipped]
timing_rounds: 3
ablations:
  - {title: Presets, baseline: corrected, variants: [slipped]}
yaw: {variants: [corrected]}
fronts:
  - {title: Cost, metric: warp.epe_median.16, variants: [corrected, slipped]}
pictures: {variants: [corrected], views: [yaw030]}
"""


class StudyFile:
    def __init__(self, folder):
        self.path = folder / "study.yaml"
        self.whole = STUDY.encode()

    def use(self, data):
        self.path.write_bytes(data)
        study = load_study(str(self.path))
        with contextlib.suppress(yaml.YAMLError):  # YAML 1.2 has texts that PyYAML does not read
            content = yaml.safe_load(data)
            for key in ("name", "scenes", "views", "seeds", "size", "spp", "timing_rounds"):
                assert key not in content or getattr(study, key) == content[key], key
            assert study.variants.keys() == content["variants"].keys()


class StudyJson:
    """study.json, with its checksum: either its content or an error."""

    def __init__(self, folder):
        self.store = run_in(folder)
        self.path = self.store.root / "study.json"
        self.whole = self.path.read_bytes()
        self.content = json.loads(self.whole)

    def use(self, data):
        self.path.write_bytes(data)
        assert self.store.read_study() == self.content


class Cell:
    """A record: either its content or an error; and the results hold the other records, and a
    failure in one line for this."""

    def __init__(self, folder):
        self.store = run_in(folder)
        cells = self.store.read_study()["cells"]
        self.cell = next(c for c in cells if c["probe"] == "depth")
        self.path = self.store.path(self.cell["id"])
        self.whole = self.path.read_bytes()
        self.content = json.loads(self.whole)
        self.others = len(cells) - 1

    def use(self, data):
        self.path.write_bytes(data)
        results = read_results(self.store)
        broken = [cell.id for cell in results.cells if cell.record is None]
        if broken:
            assert broken == [self.cell["id"]]
            (failure,) = results.failures
            assert str(self.path) in failure.error and "\n" not in failure.error
        else:
            assert len(results.cells) == self.others + 1 and not results.failures
        record = self.store.read_as(self.cell["id"], probe("depth").read)
        assert record.to_json() == {k: self.content[k] for k in record.to_json()}


FORMATS = {"study": StudyFile, "study.json": StudyJson, "cell": Cell}


def run_in(folder):
    """The stored run with one of its scenes, which loads at once."""
    store = Store(written_runs.unpack_stored(folder) / "variants")
    study = store.read_study()
    study["study"]["scenes"] = ["spheres"]
    del study["scenes"]["bear"]
    study["cells"] = [cell for cell in study["cells"] if cell["scene"] == "spheres"]
    store.write_study(study)
    return store


def failures(name, folder, seeds):
    form = FORMATS[name](folder)
    form.use(form.whole)  # the undamaged file is read
    return damage_files.failures(
        name, form.whole, form.use, seeds, refusals=(InputError,), text=True
    )


@pytest.mark.parametrize("name", FORMATS)
@damage_files.seeds_of(FAST, SLOW)
def test_a_damaged_study_or_run_is_refused_in_one_line_or_means_the_same(tmp_path, name, seeds):
    assert not (failed := failures(name, tmp_path, seeds)), "\n".join(failed)
