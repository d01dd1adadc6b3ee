"""Ctrl-C and kills of a run on worker processes. Oracles: the process table, a run that was never disturbed."""

import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest
import yaml

from attnwarp.process import core_count
from attnwarp_eval.report.results import lines, read_results
from attnwarp_eval.study import load_study
from attnwarp_eval.study.run import execute, plan
from attnwarp_eval.study.store import Store

STUDY = {
    "name": "small",
    "size": 16,
    "scenes": ["spheres"],
    "views": ["yaw030"],
    "feature_sizes": [16],
    "spp": 1,
    "variants": {f"splats {n}": {"splats": {"count": n}} for n in (200, 300, 400)},
    "probes": {"depth": ["splats 200", "splats 300", "splats 400"]},
}

# A commit made while the test runs would change the revision that reports name.
WITHOUT_GIT = {**os.environ, "GIT_DIR": "/nonexistent"}


def command(run):
    program = [sys.executable, "-m", "attnwarp_eval", "run", "study.yaml"]
    return [*program, "--out", str(run), "--jobs", "64"]


def children(pid):
    """Living processes that ``pid`` started."""
    try:
        tasks = list(pathlib.Path(f"/proc/{pid}/task").iterdir())
    except OSError:  # it has ended
        return []
    return [int(child) for task in tasks for child in read(task / "children").split()]


def workers(pid):
    """Living worker processes below ``pid``, and those that they started themselves."""
    pids = []
    for child in children(pid):
        pids += [child] if is_worker(child) else []
        pids += workers(child)
    return pids


def is_worker(pid):
    return "spawn_main" in read(pathlib.Path(f"/proc/{pid}/cmdline"))


def read(path):
    """The text of a file of a process; nothing of one that has ended."""
    try:
        return path.read_text()
    except OSError:
        return ""


def finish(folder, run):
    """The lines of results.jsonl of the run, gone on with in this process."""
    store = Store(run)
    with store.lock():
        summary = execute(plan(load_study(str(folder / "study.yaml")), store), store)
    assert summary.complete
    return list(lines(read_results(store), timings=False))


@pytest.mark.parametrize(
    ("moment", "send", "number"),
    [
        pytest.param("a cell is written", os.kill, signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param("workers start", os.kill, signal.SIGTERM, marks=pytest.mark.slow),
        # As a batch system does: to the command and to its workers.
        pytest.param("a cell is written", os.killpg, signal.SIGTERM, marks=pytest.mark.slow),
        # As a terminal does.
        pytest.param("a cell is written", os.killpg, signal.SIGINT, marks=pytest.mark.slow),
        pytest.param("workers start", os.killpg, signal.SIGINT, marks=pytest.mark.slow),
        # As a machine does that runs out of memory: nobody is left to say anything.
        pytest.param("a cell is written", os.killpg, signal.SIGKILL, marks=pytest.mark.slow),
    ],
)
def test_a_stop_of_a_run_on_workers_says_what_is_kept_and_leaves_none_of_them(
    tmp_path, moment, send, number
):
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(STUDY))
    run = tmp_path / "killed"
    process = subprocess.Popen(
        command(run), cwd=tmp_path, env=WITHOUT_GIT, text=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    started, own = set(), set()
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        started.update(workers(process.pid))
        own.update(filter(is_worker, children(process.pid)))
        if started and (moment == "workers start" or list((run / "cells").rglob("*.json"))):
            break
        time.sleep(0.01)
    send(process.pid, number)
    message = process.communicate(timeout=120)[1]
    kept = {path.name: path.stat().st_mtime_ns for path in (run / "cells").rglob("*.json")}
    if number == signal.SIGKILL:
        assert process.returncode == -number
    else:
        assert process.returncode == 130
        last = f"stopped; {len(kept)} cells are kept, the same command goes on from here\n"
        assert message.endswith(f"attnwarp-eval: {last}") and "Traceback" not in message
    assert started and not any(map(is_worker, started))
    assert len(own) <= min(core_count(), 4)  # cells
    results = finish(tmp_path, run)
    assert {name: Store(run).path(name[:-5]).stat().st_mtime_ns for name in kept} == kept
    assert results and results == finish(tmp_path, tmp_path / "undisturbed")
