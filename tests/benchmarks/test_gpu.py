"""The benchmark of the GPU backend: it says that there is no GPU, and runs on Warp's CPU device."""

import json

import pytest
import torch

import benchmarks.gpu


def test_without_a_gpu_it_says_so_and_exits_with_code_2(capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit) as ended:
        benchmarks.gpu.main([])
    assert ended.value.code == 2
    assert "no GPU that torch can use" in capsys.readouterr().err


@pytest.mark.slow
def test_every_figure_is_made(tmp_path):
    benchmarks.gpu.main(["--device", "cpu", "--tiny", "--out", str(tmp_path / "gpu.json")])
    figures = json.loads((tmp_path / "gpu.json").read_text())
    assert all(row["color"] < 1e-5 and row["gradient"] < 1e-4 for row in figures["agreement"])
    assert {row["kind"] for row in figures["rendering"]} == {"2d", "3d"}
    assert all(row["attnwarp_backward_ms"] > 0 for row in figures["rendering"])
    assert figures["fit"]["views"] == 3 and figures["fit"]["seconds"] > 0
    assert figures["edit"]["edited"] == 3 and set(figures["edit"]["parts"]) >= {"edit", "tune"}
