"""The run as a user meets it: its commands, on a small study of real cells. Commands run in processes
of their own where a process is killed or starts others.

Oracles: the file system (which cells were there before), byte equality of reports, exit codes.
"""

import contextlib
import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import threading
import time

import pytest
import torch
import yaml
from matplotlib.figure import Figure
from typer.testing import CliRunner

from attnwarp.render.threads import set_thread_count
from attnwarp_eval.cli.main import app
from attnwarp_eval.cost import environment
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.store import Store

SMALL = {
    "name": "small",
    "size": 64,
    "scenes": ["spheres"],
    "views": ["yaw030", "yaw150"],
    "feature_sizes": [64, 16],
    "spp": 1,
    "splats": {"count": 2000},
    "variants": {
        "corrected": {"preset": "corrected"},
        "bounds only": {
            "set": {
                "in_front": False,
                "opaque": None,
                "depth_agreement": False,
                "normal_test": "none",
            },
        },
        "released": {"preset": "released"},
    },
    "probes": {
        "depth": ["corrected", "released"],
        "warp": ["corrected", "bounds only", "released"],
        "timing": ["corrected", "released"],
    },
    "timing_rounds": 3,
    "ablations": [
        {
            "title": "Presets",
            "probe": "warp",
            "baseline": "corrected",
            "variants": ["bounds only", "released"],
        }
    ],
    "yaw": {"variants": ["corrected", "bounds only"]},
    "fronts": [
        {
            "title": "Cost",
            "probe": "warp",
            "metric": "warp.epe_median.16",
            "variants": ["corrected", "released"],
        }
    ],
    "pictures": {"variants": ["corrected"], "views": ["yaw030"]},
}
CELLS = 7


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The working folder of the commands."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "study.yaml").write_text(yaml.safe_dump(SMALL))
    threads = torch.get_num_threads()
    environment.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        # Charts are laid out by the tests of charts; half of the CPU of these would be theirs.
        patch.setattr(Figure, "draw_without_rendering", lambda figure: None)
        # A commit made while the tests run would change the revision that reports name.
        patch.setenv("GIT_DIR", "/nonexistent")
        yield folder
    environment.cache_clear()
    torch.set_num_threads(threads)
    set_thread_count(None)


def call(*arguments):
    """A command in this process, as starting one costs seconds of imports."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def start(*arguments, **options):
    """A command in a process of its own."""
    command = [sys.executable, "-m", "attnwarp_eval", *map(str, arguments)]
    return subprocess.Popen(command, text=True, **options)


def test_a_dry_run_names_the_variants_that_one_cell_times_in_turn(folder):
    done = call("run", "study.yaml", "--out", "never", "--dry-run")
    rows = [line for line in done.stdout.splitlines() if " timing " in line]
    # Of another content each, they are no names of one variant.
    assert done.exit_code == 0 and len(rows) == 1
    assert "corrected, released (in turn)" in rows[0] and "=" not in rows[0]


def test_seeds_of_the_command_line_stand_in_for_the_studys(folder):
    """Oracle: the number of cells, of which calibration alone has no seed."""
    counts = []
    for seeds in ("5", "5,3"):
        done = call("run", "study.yaml", "--out", "never", "--dry-run", "--seeds", seeds)
        assert done.exit_code == 0 and f"seeds {seeds.replace(',', ', ')};" in done.stdout
        counts.append(int(re.search(r"(\d+) cells, 0 done", done.stdout)[1]))
    assert counts == [CELLS, 2 * (CELLS - 1) + 1]


def without_timings(run):
    done = call("report", run, "--no-timings")
    assert done.exit_code == 0, done.stderr
    return {
        name: (run / name).read_bytes() for name in ("report.md", "report.html", "results.jsonl")
    }


@pytest.fixture(scope="module")
def finished(folder):
    """A run that was never disturbed."""
    done = call("run", "study.yaml", "--out", "undisturbed")
    assert done.exit_code == 0, done.stderr
    assert done.stderr.count("\n[") == CELLS
    return folder / "undisturbed"


@pytest.fixture(scope="module")
def undisturbed(finished, tmp_path_factory):
    """The report of that run, without seconds."""
    run = tmp_path_factory.mktemp("reports") / "undisturbed"
    shutil.copytree(finished, run)
    return without_timings(run)


def test_a_finished_run_has_its_report_numbers_and_pictures_and_verifies(finished, folder):
    assert call("verify", "undisturbed").exit_code == 0
    page = (finished / "report.html").read_text()
    assert "data:image/jpeg;base64," in page
    assert "<svg xmlns" in page
    assert "<td>again</td>" in page
    assert "http" not in page.replace("http://www.w3.org", "")
    lines = [json.loads(line) for line in (finished / "results.jsonl").read_text().splitlines()]
    assert all(line["seconds"]["method"] > 0 and line["counters"] for line in lines)
    assert {line["probe"] for line in lines} == {"calibration", "depth", "warp"}


def test_a_damaged_cell_costs_itself_and_is_mended_by_the_next_run(finished, undisturbed, folder):
    run = folder / "damaged"
    shutil.copytree(finished, run)
    victim = next(p for p in (run / "cells").rglob("*.json") if '"depth"' in p.read_text())
    victim.write_bytes(victim.read_bytes()[:100])
    assert call("verify", run).exit_code == 3
    done = call("report", run)
    assert done.exit_code == 3
    assert f"1 of {CELLS} cells failed or are damaged, 1 have no figures" in done.stderr
    assert f"attnwarp-eval verify {run} names them" in done.stderr and done.stderr.count("\n") == 1
    assert "not JSON" in (run / "report.md").read_text()
    mended = call("run", "study.yaml", "--out", run)
    assert mended.exit_code == 0, mended.stderr
    assert f"{CELLS - 1} already done" in mended.stderr
    assert without_timings(run) == undisturbed


def test_the_report_of_an_unfinished_run_says_how_much_is_missing(finished, folder):
    run = folder / "unfinished"
    shutil.copytree(finished, run)
    assert call("report", run).stderr == ""
    for cell in [p for p in (run / "cells").rglob("*.json") if '"depth"' in p.read_text()][:1]:
        cell.unlink()
    done = call("report", run)
    assert done.exit_code == 0
    assert f"1 of {CELLS} cells are missing, as the run is unfinished" in done.stderr
    shutil.rmtree(run / "cells")
    done = call("report", run)
    assert done.exit_code == 3 and f"none of {CELLS} cells was measured" in done.stderr


def test_a_damaged_picture_is_refused_by_name_and_made_anew(finished, folder):
    run = folder / "damaged-pictures"
    shutil.copytree(finished, run)
    victim = sorted((run / "pictures").rglob("*.jpg"))[0]
    whole = victim.read_bytes()
    victim.write_bytes(whole[:-40] + bytes(40))
    checked = call("verify", run)
    assert checked.exit_code == 3
    assert f"{victim}: changed since it was written; run again with --out {run}" in checked.stdout
    refused = call("report", run)
    assert refused.exit_code == 2
    assert f"{victim}: changed since" in refused.stderr and refused.stderr.count("\n") == 1
    assert call("report", run, "--no-pictures").exit_code == 0
    mended = call("run", "study.yaml", "--out", run)
    assert mended.exit_code == 0, mended.stderr
    assert f"{CELLS - 1} already done" in mended.stderr
    assert victim.read_bytes() == whole
    assert call("verify", run).exit_code == 0


@contextlib.contextmanager
def interrupted(moment):
    """Ctrl-C reaches this process once ``moment()`` is true, unless what runs inside has ended."""
    running = True

    def interrupt(number, frame):
        if running:
            raise KeyboardInterrupt

    def watch():
        while running and not moment():
            time.sleep(0.002)
        os.kill(os.getpid(), signal.SIGINT)

    handler = signal.signal(signal.SIGINT, interrupt)
    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield
    finally:
        running = False
        thread.join()
        signal.signal(signal.SIGINT, handler)


# Ctrl-C may come between the opening of a file and the block that closes it.
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interrupted_run_says_what_is_kept_and_how_to_go_on(folder):
    # On a busy machine the run may be over before the signal is sent: then once more.
    for attempt in range(5):
        run = folder / f"interrupted{attempt}"
        with interrupted(lambda run=run: list((run / "cells").rglob("*.json"))):
            done = call("run", "study.yaml", "--out", run)
        if done.exit_code != 0:
            break
    assert done.exit_code == 130
    count = len(list((run / "cells").rglob("*.json")))
    assert 1 <= count < CELLS
    last = f"stopped; {count} cells are kept, the same command goes on from here"
    assert done.stderr.splitlines()[-1] == f"attnwarp-eval: {last}"
    assert "Traceback" not in done.stderr


def test_ctrl_c_that_native_code_turns_into_its_own_error_still_ends_the_run(folder, monkeypatch):
    """CPython does so if a function of an extension is interrupted in the middle."""

    def interrupted(*_):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise SystemError("<method> returned a result with an exception set") from error

    run = folder / "native"
    monkeypatch.setattr(probe("warp"), "compute", interrupted)
    done = call("run", "study.yaml", "--out", run)
    assert done.exit_code == 130
    assert "stopped; " in done.stderr.splitlines()[-1]
    assert not (run / "failed").exists() or not list((run / "failed").iterdir())


def test_an_instrument_that_is_not_calibrated_ends_with_exit_code_3(finished, folder):
    run = folder / "uncalibrated"
    shutil.copytree(finished, run)
    store = Store(run)
    record = next(r for r in map(store.read, store.done()) if r["spec"]["probe"] == "calibration")
    record["views"][0]["metrics"]["warp.epe_median"] = 0.5
    store.write({k: v for k, v in record.items() if k != "sha256"})
    done = call("run", "study.yaml", "--out", run)
    assert done.exit_code == 3
    assert "not calibrated" in done.stderr
    assert "is not calibrated" in (run / "report.md").read_text()


@pytest.mark.slow
def test_a_run_that_takes_the_place_of_anothers_report_says_so(finished, folder):
    run = folder / "reused"
    shutil.copytree(finished, run)
    assert "Name another folder" not in call("run", "study.yaml", "--out", run).stderr
    again = call("run", "study.yaml", "--size", "72", "--out", run)
    assert again.exit_code == 0, again.stderr
    # No cell of one size is one of the other.
    assert f"{CELLS} of the cells in {run} are of other sizes" in again.stderr
    assert len(Store(run).done()) == 2 * CELLS


def test_an_adaptive_cluster_starts_a_worker_that_gives_the_same_numbers_and_pictures(
    finished, undisturbed, folder
):
    from distributed import LocalCluster

    run = folder / "elsewhere"
    none = {"n_workers": 0, "threads_per_worker": 1, "memory_limit": 0}
    # Any free port: a run beside the tests may have dask's usual one.
    place = {"dashboard_address": "127.0.0.1:0", "scheduler_kwargs": {"dashboard": False}}
    # Workers are threads of this process, which costs no start of another.
    with LocalCluster(processes=False, **none, **place) as cluster:
        cluster.adapt(minimum=0, maximum=1, interval="50ms")
        done = call("run", "study.yaml", "--out", run, "--scheduler", cluster.scheduler_address)
    assert done.exit_code == 0, done.stderr
    assert done.stderr.count("\n[") == CELLS
    assert without_timings(run) == undisturbed
    names = {path.relative_to(finished) for path in finished.glob("pictures/*/*.jpg")}
    assert names == {path.relative_to(run) for path in run.glob("pictures/*/*.jpg")}
    assert all((run / name).read_bytes() == (finished / name).read_bytes() for name in names)


def test_a_cell_that_fails_costs_itself_alone_and_exit_code_3(folder):
    run = folder / "failing"
    run.mkdir()
    # A file where the pictures' folder should be: the three cells that keep pictures fail, as on a
    # full disk.
    (run / "pictures").write_text("in the way")
    done = call("run", "study.yaml", "--out", run)
    assert done.exit_code == 3
    assert "failed cells" in done.stderr
    assert len(list((run / "cells").rglob("*.json"))) == CELLS - 3
    assert len(list((run / "failed").iterdir())) == 3
    assert "Failed cells" in (run / "report.md").read_text()
    assert call("verify", run).exit_code == 3
    stopped = call("run", "study.yaml", "--out", run, "--fail-fast")
    assert stopped.exit_code == 3
    (run / "pictures").unlink()
    mended = call("run", "study.yaml", "--out", run)
    assert mended.exit_code == 0, mended.stderr
    assert "4 already done" in mended.stderr
    assert call("verify", run).exit_code == 0


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_its_attempt_and_nothing_else(undisturbed, folder):
    run = folder / "bereft"
    process = start("run", "study.yaml", "--out", run, "--jobs", "2", stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 300
    while not list((run / "cells").rglob("*.json")) and time.monotonic() < deadline:
        time.sleep(0.02)
    workers = [
        pid
        for pid in children(process.pid)
        if "spawn_main" in pathlib.Path(f"/proc/{pid}/cmdline").read_text()
    ]
    assert workers
    os.kill(workers[0], signal.SIGKILL)
    assert process.wait(300) == 0
    assert without_timings(run) == undisturbed


def children(pid):
    """Processes below ``pid``, nearest first."""
    result = [
        int(c)
        for t in pathlib.Path(f"/proc/{pid}/task").iterdir()
        for c in (t / "children").read_text().split()
    ]
    return result + [grandchild for child in result for grandchild in children(child)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "quik"), "did you mean 'quick'"),
        (("run", "study.yaml", "--scenes", "sphere"), "did you mean 'spheres'"),
        (("run", "study.yaml", "--seeds", "0,one"), "--seeds: got '0,one', expected whole numbers"),
        (("run", "study.yaml", "--jobs", "0"), "jobs"),
        (("run", "study.yaml", "--out", "study.yaml"), "study.yaml: is a file, expected a run"),
        (("verify", "nowhere"), "attnwarp-eval run"),
        (("scenes", "show", "nothing.yaml"), "no such scene file"),
    ],
)
def test_bad_input_gets_a_clear_line_and_exit_code_2(folder, arguments, message):
    done = call(*arguments)
    assert done.exit_code == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr


def test_one_broken_scene_does_not_hide_the_others(tmp_path, monkeypatch):
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "aaa.yaml").write_text("nam: x\n")
    monkeypatch.chdir(tmp_path)
    done = call("scenes", "list")
    assert done.exit_code == 2
    assert "bear " in done.stdout
    assert "aaa.yaml" in done.stderr


def test_a_view_whose_name_would_leave_the_folder_is_refused(tmp_path, monkeypatch):
    shipped = pathlib.Path(__file__).parents[3] / "scenes" / "spheres.yaml"
    text = shipped.read_text().replace(
        "{yaw: 10, height: 1.9}", "{name: ../../evil, yaw: 10, height: 1.9}"
    )
    (tmp_path / "evil.yaml").write_text(text)
    monkeypatch.chdir(tmp_path)
    done = call("scenes", "render", "evil.yaml", "--out", "out")
    assert done.exit_code == 2
    assert "../../evil" in done.stderr
    assert not (tmp_path / "out").exists()
