"""Probes and methods from outside of the package. Oracle: the plugin's own closed form."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from attnwarp.errors import InputError
from attnwarp_eval import cost, plugins
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import Store, parse_study
from attnwarp_eval.study.probe import probe, unregister
from attnwarp_eval.study.run import expected, plan, stored_study, verify
from attnwarp_eval.study.shared import editing_methods

HELPERS = Path(__file__).parents[1] / "helpers"
PLUGIN = """\
from chord_probe import Chord
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS, Method
from attnwarp_eval.study.probe import register

register(Chord)
EDITING_METHODS["mine"] = Method(lambda preset, fields, seed: {"seed": seed}, None)
"""
STUDY = {
    "name": "own",
    "size": 16,
    "scenes": ["spheres"],
    "views": ["yaw090"],
    "spp": 1,
    "variants": {"plain": {}, "double": {"stretch": 2.0}},
    "probes": {"chord": ["plain", "double"]},
}


@pytest.fixture(autouse=True)
def plugins_of_this_test(monkeypatch):
    """Plugins of one test are not part of the code of others."""
    monkeypatch.setattr(cost, "_plugins", {})
    yield
    cost.source_hash.cache_clear()
    cost.environment.cache_clear()


@pytest.mark.parametrize(
    ("package", "plugin"), [(False, "my_other"), (True, "my_other"), (True, "my_other.door")]
)
def test_cells_of_a_plugin_that_changed_are_of_other_code(tmp_path, monkeypatch, package, plugin):
    cost.source_hash.cache_clear()
    alone = cost.source_hash()
    file = tmp_path / ("my_other/inner.py" if package else "my_other.py")
    file.parent.mkdir(exist_ok=True)
    if package:
        (tmp_path / "my_other/__init__.py").write_text("from my_other import inner\n")
        (tmp_path / "my_other/door.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("ATTNWARP_PLUGINS", plugin)
    hashes = []
    for text in ("answer = 1\n", "answer = 2\n", "answer = 1\n"):
        file.write_text(text)
        plugins.load_plugins.__wrapped__()
        hashes.append(cost.environment()["source"])
        for name in ("my_other", "my_other.inner", "my_other.door"):
            sys.modules.pop(name, None)
    assert hashes[0] == hashes[2] and len({alone, *hashes}) == 3


def test_a_plugin_registers_its_probe_and_its_method(tmp_path, monkeypatch):
    (tmp_path / "my_plugin.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("ATTNWARP_PLUGINS", " my_plugin, ")
    monkeypatch.setattr(editing_methods, "EDITING_METHODS", dict(editing_methods.EDITING_METHODS))
    plugins.load_plugins.__wrapped__()
    try:
        assert type(probe("chord")).__module__ == "chord_probe"
        assert editing_methods.EDITING_METHODS["mine"].settings("paper", {}, 3) == {"seed": 3}
    finally:
        unregister("chord")
        sys.modules.pop("my_plugin")


@pytest.mark.slow
def test_a_plugin_of_the_environment_has_its_probe_in_every_worker(tmp_path):
    (tmp_path / "my_plugin.py").write_text(PLUGIN)
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(STUDY))
    paths = [str(tmp_path), str(HELPERS), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(paths),
        "ATTNWARP_PLUGINS": " my_plugin, ",
    }
    command = [sys.executable, "-m", "attnwarp_eval", "run", "own.yaml", "--jobs", "2"]
    done = subprocess.run(
        [*command, "--out", "run"], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in (tmp_path / "run/results.jsonl").read_text().splitlines()]
    length = {row["variant"]: row["value"] for row in rows if row["metric"] == "chord.length"}
    cameras = load_scene("spheres").spec.cameras
    (height,) = {t.height for t in cameras.targets if t.yaw - cameras.source.yaw == 90}
    chord = math.hypot(math.sqrt(2) * cameras.radius, height - cameras.source.height)
    assert length == {"plain": pytest.approx(chord), "double": pytest.approx(2 * chord)}
    without = {key: value for key, value in environment.items() if key != "ATTNWARP_PLUGINS"}
    for name in ("report", "verify"):
        command = [sys.executable, "-m", "attnwarp_eval", name, "run"]
        done = subprocess.run(command, cwd=tmp_path, env=without, capture_output=True, text=True)
        assert done.returncode == 2 and "set ATTNWARP_PLUGINS=my_plugin" in done.stderr


def test_a_run_with_a_plugin_that_is_not_here_names_it(tmp_path):
    store = Store(tmp_path / "run")
    content = {"name": "own", "scenes": ["spheres"], "variants": {"a": {}}}
    stored = expected(plan(parse_study(content | {"probes": {"depth": ["a"]}}), store))
    assert stored["plugins"] == ["attnwarp_lab.probes"]  # the laboratory, which comes along
    store.write_study(stored | {"plugins": ["my_plugin"]})
    assert verify(store).missing  # what needs no plugin is read without it
    stored["study"]["probes"] = {"chord": ["a"]}
    store.write_study(stored | {"plugins": ["my_plugin"]})
    for read in (verify, stored_study):
        with pytest.raises(InputError, match="plugins my_plugin, which are not named here; .*set"):
            read(store)


@pytest.mark.door
@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "ATTNWARP_PLUGINS: the plugin 'my_broken' cannot be imported: ModuleNotFoundError"),
        ("raise SystemExit(1)", "the plugin 'my_broken' cannot be imported: SystemExit: 1"),
    ],
)
def test_a_plugin_that_cannot_be_imported_is_named(tmp_path, monkeypatch, text, says):
    if text is not None:
        (tmp_path / "my_broken.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("ATTNWARP_PLUGINS", "my_broken")
    with pytest.raises(InputError, match=says):
        plugins.load_plugins.__wrapped__()
