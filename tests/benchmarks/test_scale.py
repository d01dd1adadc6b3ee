"""The benchmark of large studies. Oracle: the steps' names, and a step that must fail."""

import re
import sys

import pytest

from benchmarks import scale


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["benchmarks.scale", *map(str, arguments)])
    scale.main()


@pytest.fixture(autouse=True)
def probe_for_these_tests_alone():
    from attnwarp_eval.study.probe import unregister

    yield
    unregister("free")


@pytest.mark.door
def test_every_step_of_the_documents_command_is_measured(monkeypatch, tmp_path, capfd):
    out = tmp_path / "report.md"
    run(monkeypatch, "--cells", "32", "--folder", tmp_path, "--out", out)
    rows = re.findall(r"^\| (.+?) \| (.+?) s, (.+?) s, (.+?) MiB \|$", out.read_text(), re.M)
    assert [name for name, *_ in rows] == [
        "plan",
        "store",
        "plan again",
        "verify",
        "report",
        "compare",
    ]
    assert all(float(cpu) >= 0 and float(mb) > 10 for _, cpu, _, mb in rows)
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.door
def test_a_step_that_fails_leaves_the_others_their_figures(monkeypatch, tmp_path):
    # No process of its own knows this step, so it ends with an error there.
    steps = {"plan": scale.STEPS["plan"], "unknown": scale.STEPS["plan"]}
    monkeypatch.setattr(scale, "STEPS", steps)
    out = tmp_path / "report.md"
    with pytest.raises(SystemExit, match="failed: unknown at 16 cells"):
        run(monkeypatch, "--cells", "16", "--folder", tmp_path, "--out", out)
    plan, unknown = out.read_text().splitlines()[2:]
    assert "MiB" in plan and unknown == "| unknown | failed |"
