"""A run on the user's own cluster: a real scheduler and real workers, each a process in a folder of its own.
No worker can open a file below the folder of the run. Oracle: the same study in one process."""

import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
import yaml
from typer.testing import CliRunner

import attnwarp
import attnwarp_eval
import attnwarp_eval.study.cluster
from attnwarp.reporting import SILENT
from attnwarp_eval.cli.main import app
from attnwarp_eval.report import write_report
from attnwarp_eval.study.record import Failure
from attnwarp_eval.study.reporting import CellReporter
from attnwarp_eval.study.store import Store

ROOT = pathlib.Path(attnwarp.__file__).parents[1]

STUDY = {
    "name": "small",
    "size": 32,
    "scenes": ["spheres", "mine/own.yaml"],
    "views": ["yaw030"],
    "feature_sizes": [32],
    "spp": 1,
    "variants": {f"splats {n}": {"splats": {"count": n}} for n in range(200, 1000, 100)},
    "probes": {"depth": [f"splats {n}" for n in range(200, 1000, 100)]},
    "pictures": {"variants": ["splats 200"], "views": ["yaw030"]},
}
CELLS = 18

# A scene of the user's own, whose mesh lies in another folder.
OWN = """
name: own
title: A tetrahedron
objects:
  - name: thing
    shape: {type: mesh, file: ../meshes/thing.ply}
    texture: {type: checker, colors: ['#7a3b8f', '#e6d3ea'], size: 0.2, variation: 0.2}
lights: [{type: sky, horizon: '#cfdcea', zenith: '#6f9fd8', radiance: 1.0}]
cameras:
  look_at: [0, 0, 0]
  radius: 4
  fov: 46
  source: {yaw: 0, height: 1.5}
  targets: [{yaw: 30, height: 1.5}]
"""
TETRAHEDRON = """\
ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 4
property list uchar int vertex_indices
end_header
1 1 1
-1 -1 1
-1 1 -1
1 -1 -1
3 0 2 1
3 0 1 3
3 0 3 2
3 1 2 3
"""

# What each worker process runs before anything else.
NO_SHARED_DISK = """
import os, sys
FORBIDDEN = os.environ["FORBIDDEN"]
def refuse(event, arguments):
    if event in ("open", "os.listdir", "os.scandir", "os.mkdir", "os.rename") and isinstance(arguments[0], (str, bytes)):
        if os.path.abspath(os.fsdecode(arguments[0])).startswith(FORBIDDEN):
            raise PermissionError(f"no shared disk: {arguments[0]}")
sys.addaudithook(refuse)
"""


@pytest.fixture
def home(tmp_path):
    """The folder of the command, with the study."""
    home = tmp_path / "home"
    (home / "mine").mkdir(parents=True)
    (home / "meshes").mkdir()
    (home / "study.yaml").write_text(yaml.safe_dump(STUDY))
    (home / "mine" / "own.yaml").write_text(OWN)
    (home / "meshes" / "thing.ply").write_text(TETRAHEDRON)
    return home


@pytest.fixture
def cluster(tmp_path, home):
    """Starts processes of a cluster; ends those that are left."""
    started = []

    class Cluster:
        file = tmp_path / "scheduler" / "scheduler.json"

        def start(self, name, *arguments, code=ROOT):
            folder = tmp_path / name
            folder.mkdir()
            (folder / "sitecustomize.py").write_text(NO_SHARED_DISK)
            environment = {
                **os.environ,
                "FORBIDDEN": str(home),
                "PYTHONPATH": os.pathsep.join(map(str, [folder, code, code / "eval"])),
                "ATTNWARP_CACHE": str(folder / "derived"),
            }
            command = [sys.executable, "-m", "dask", *arguments]
            with (folder / "log").open("w") as log:
                process = subprocess.Popen(
                    command, cwd=folder, env=environment, stdout=log, stderr=log
                )
            started.append(process)
            return process

        def scheduler(self):
            place = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
            process = self.start(
                "scheduler", "scheduler", *place, "--scheduler-file", self.file.name
            )
            wait(self.file.exists)
            return process

        def worker(self, name, code=ROOT):
            address = json.loads(self.file.read_text())["address"]
            options = ["--no-nanny", "--nthreads", "1", "--memory-limit", "0", "--no-dashboard"]
            folder = ["--local-directory", "scratch", "--name", name]
            return self.start(name, "worker", address, *options, *folder, code=code)

    yield Cluster()
    for process in started:
        process.kill()
        process.wait()


def run(home, out, *options):
    """The command, in a process of its own."""
    command = [sys.executable, "-m", "attnwarp_eval", "run", "study.yaml", "--out", out]
    # A commit made while the test runs would change the revision that records name.
    environment = {
        **os.environ,
        "GIT_DIR": "/nonexistent",
        "PYTHONPATH": os.pathsep.join(map(str, [ROOT, ROOT / "eval"])),
    }
    log = home / f"{out}.log"
    with log.open("a") as stream:
        process = subprocess.Popen(
            [*command, *options], cwd=home, env=environment, stdout=stream, stderr=stream
        )
    return process, log


def wait(condition, seconds=300):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def cells(folder):
    return len(list((folder / "cells").rglob("*.json")))


def contents(folder):
    """All of a run but what was measured in seconds: records, pictures, report."""
    store = Store(folder)
    write_report(store, timings=False)
    files = {
        name: (folder / name).read_bytes() for name in ("results.jsonl", "report.md", "report.html")
    }
    for path in sorted((folder / "pictures").rglob("*.jpg")):
        files[str(path.relative_to(folder))] = path.read_bytes()
    records = [store.read(cell) for cell in sorted(store.done())]
    return files, [{k: v for k, v in r.items() if k not in ("cost", "sha256")} for r in records]


@pytest.mark.slow
def test_workers_without_a_shared_disk_give_the_bytes_of_one_process_though_one_is_killed(
    home, cluster, tmp_path
):
    cluster.scheduler()
    copy = tmp_path / "other-version"
    for source in (
        pathlib.Path(attnwarp.__file__).parent,
        pathlib.Path(attnwarp_eval.__file__).parent,
    ):
        # The bundled weights are not read here, and are large.
        target = copy / source.relative_to(ROOT)
        shutil.copytree(source, target, ignore=shutil.ignore_patterns("weights", "__pycache__"))
    with (copy / "attnwarp" / "camera.py").open("a") as stream:
        stream.write("# another version\n")
    first, second = cluster.worker("first"), cluster.worker("second")
    cluster.worker("stranger", code=copy)
    process, log = run(home, "far", "--scheduler", str(cluster.file))
    wait(lambda: cells(home / "far") >= 3)
    # Both stand still at a cell. The first dies there, and the next cells are the added worker's.
    first.send_signal(signal.SIGSTOP)
    second.send_signal(signal.SIGSTOP)
    time.sleep(1.5)
    before = cells(home / "far")
    assert before < CELLS - 3
    first.kill()
    cluster.worker("added")
    wait(lambda: cells(home / "far") >= before + 2)
    second.send_signal(signal.SIGCONT)
    assert process.wait(300) == 0, log.read_text()
    text = log.read_text()
    assert "was lost at" in text and "the cell is tried once more" in text
    assert "worker stranger (tcp://" in text and "is refused: source" in text
    assert all(text.count(f"\n[{n}/{CELLS}] ") == 1 for n in range(1, CELLS + 1))

    alone, log = run(home, "near")
    assert alone.wait(300) == 0, log.read_text()
    assert contents(home / "far") == contents(home / "near")


@pytest.mark.slow
def test_a_run_whose_scheduler_is_lost_says_so_and_goes_on_from_there(home, cluster):
    scheduler = cluster.scheduler()
    cluster.worker("only")
    process, log = run(home, "lost", "--scheduler", str(cluster.file))
    wait(lambda: cells(home / "lost") >= 2)
    scheduler.kill()
    assert process.wait(120) == 3
    count = cells(home / "lost")
    assert 2 <= count < CELLS
    message = f"broke; {count} cells are kept, the same command goes on from here\n"
    assert log.read_text().endswith(message) and "Traceback" not in log.read_text()
    again, log = run(home, "lost")
    assert again.wait(300) == 0
    assert f"{count} already done" in log.read_text()


def test_a_cluster_that_closes_badly_does_not_hide_the_interrupt():
    class Stuck:
        """A cluster like dask's on a busy machine."""

        def close(self):
            raise TimeoutError

    with pytest.raises(KeyboardInterrupt), attnwarp_eval.study.cluster._closed(Stuck()):
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("scheduler", "message"),
    [
        ("nowhere.json", "neither an address such as tcp://host:8786 nor a scheduler file"),
        ("study.yaml", "neither an address such as tcp://host:8786 nor a scheduler file"),
        ("tcp:/host:8786", "neither an address such as tcp://host:8786 nor a scheduler file"),
        ("udp://host:8786", "no scheduler at udp://host:8786 (unknown address scheme 'udp'"),
    ],
)
def test_a_scheduler_that_is_none_is_refused_in_one_line(home, monkeypatch, scheduler, message):
    monkeypatch.chdir(home)
    done = CliRunner().invoke(app, ["run", "study.yaml", "--out", "x", "--scheduler", scheduler])
    assert done.exit_code == 2
    assert message in done.stderr and "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].startswith("attnwarp-eval: --scheduler: ")


def test_a_worker_that_cannot_read_what_its_cells_need_is_refused_by_name(tmp_path, monkeypatch):
    from distributed import LocalCluster

    module = attnwarp_eval.study.cluster
    monkeypatch.setattr(module, "REFUSED_SECONDS", 0.5)
    cells = [module.Cell({}, "ball", "v", "warp", 0)]
    needs = [tmp_path, tmp_path / "nowhere"]
    place = {"dashboard_address": "127.0.0.1:0", "scheduler_kwargs": {"dashboard": False}}
    with LocalCluster(1, processes=False, threads_per_worker=1, memory_limit=0, **place) as cluster:
        report = CellReporter(len(cells), 0, SILENT)
        address = cluster.scheduler_address
        work = module.run_on_scheduler(cells, Store(tmp_path), {}, address, report, needs)
        with pytest.raises(module.ClusterError) as raised:
            list(work)
    told = f"cannot read {tmp_path}/nowhere, expected under these paths"
    assert "every worker was refused: worker 0 (" in str(raised.value)
    assert str(raised.value).endswith(told)


def test_a_worker_gets_a_scenes_files_again_when_it_comes_back_or_a_cell_of_it_fails(monkeypatch):
    """A new process under an old address has none; nor has one whose disk was full."""
    cluster = attnwarp_eval.study.cluster
    monkeypatch.setattr(cluster, "files_of_scene", lambda scene: "files")
    cell = cluster.Cell({}, "ball", "v", "warp", 0)
    place, sent = cluster._Remote(Store("none"), {"ball": None}), []
    client = SimpleNamespace(submit=lambda do, probe, cell, files, **_: sent.append(files))
    runner = cluster._Runner(client, [], place, CellReporter(0, 0, SILENT))
    for worker in ("tcp://a:1", "tcp://a:1", "tcp://b:1"):
        place.submit(client, worker, cell)
    assert sent == ["files", None, "files"]
    assert list(runner._give_up("tcp://a:1")) == []
    place.submit(client, "tcp://a:1", cell)
    place.submit(client, "tcp://b:1", cell)
    assert sent[3:] == ["files", None]
    failed = Failure("ball", "v", "warp", "OSError: no space left")
    assert place.receive(cell, failed) is failed
    place.submit(client, "tcp://b:1", cell)
    assert sent[5:] == ["files"]


def test_a_malformed_configuration_of_dasks_is_named_in_a_line(tmp_path):
    """In a process of its own: dask reads it when it is imported."""
    (tmp_path / "mine.yaml").write_text("distributed: [\n")
    code = "from attnwarp_eval.study.cluster import _silent\nwith _silent(): pass"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "DASK_CONFIG": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    *_, last = done.stderr.splitlines()
    assert "ClusterError: dask cannot read its configuration" in last
    assert f"{tmp_path}/mine.yaml" in last and last.endswith("or run with --jobs 1")
