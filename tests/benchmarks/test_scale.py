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
