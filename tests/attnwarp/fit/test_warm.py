"""Compilation stays out of the seconds of a fit. Oracle: a clock that only compilation moves."""

import time
from types import SimpleNamespace

import pytest
import torch
from edit_folders import Watched

from attnwarp.fit import FitSettings, fit, loop, warm

from .conftest import blobs


@pytest.fixture
def cold(monkeypatch):
    monkeypatch.setattr(warm, "_ready", set())


def test_seconds_of_a_fit_hold_no_compilation(scene, monkeypatch):
    now = [0.0]

    def compiled(kind, report, device):
        now[0] += 60

    clock = SimpleNamespace(perf_counter=lambda: now[0], process_time=lambda: now[0])
    monkeypatch.setattr(loop, "time", clock)
    monkeypatch.setattr(loop, "compile_kernels", compiled)
    result = fit(
        blobs(), scene[0], FitSettings(kind="3d", sh_degree=0, iterations=2), max_seconds=30
    )
    assert now == [60] and result.stopped == "iterations"
    assert [record.seconds for record in result.history] == [0, 0]


def test_a_long_compilation_is_told_once(cold, monkeypatch):
    real, said = warm.render, []

    def slow(*args, **more):
        time.sleep(0.3)
        return real(*args, **more)

    monkeypatch.setattr(warm, "QUIET_SECONDS", 0.01)
    monkeypatch.setattr(warm, "render", slow)
    warm.compile_kernels("2d", Watched(log=said.append))
    warm.compile_kernels("2d", Watched(log=said.append))
    (line,) = said
    assert line.startswith("loading the renderer; after an installation it is compiled once")


@pytest.mark.parametrize("off", [torch.no_grad, torch.inference_mode])
def test_it_works_where_gradients_are_switched_off(cold, off):
    with off():
        warm.compile_kernels("2d")
        assert not torch.is_grad_enabled()


def test_quick_kernels_are_not_worth_a_word(cold, monkeypatch):
    monkeypatch.setattr(warm, "QUIET_SECONDS", 600)
    said = []
    warm.compile_kernels("3d", Watched(log=said.append))
    assert said == []
