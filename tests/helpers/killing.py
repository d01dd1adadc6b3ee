"""Kills a study's run, its report and its comparison at random moments, and starts each again.

    python tests/helpers/killing.py 100 FOLDER

Commands are forks of one process that has imported everything: a kill then hits the work, not the imports.
"""

import os
import pathlib
import random
import shutil
import signal
import subprocess
import sys
import time

STUDY = """
name: killed
size: 32
scenes: [spheres, opposed]
feature_sizes: [32]
spp: 1
splats: {count: 500}
variants:
  corrected: {preset: corrected}
  released: {preset: released}
probes: {depth: [corrected, released], warp: [corrected, released]}
ablations: [{title: Presets, probe: warp, baseline: corrected, variants: [released]}]
pictures: {variants: [corrected, released], views: [yaw045, yaw030, yaw150]}
"""


def fork(arguments, log):
    """A command of attnwarp-eval in a process of its own; returns its id."""
    pid = os.fork()
    if pid:
        return pid
    code = 70
    try:
        stream = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(stream, 1)
        os.dup2(stream, 2)
        from attnwarp_eval.cli.main import app

        app(arguments, standalone_mode=False)
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    finally:
        os._exit(code)


def whole(arguments, log):
    """Run a command to its end; its seconds."""
    start = time.monotonic()
    status = os.waitpid(fork(arguments, log), 0)[1]
    assert os.waitstatus_to_exitcode(status) == 0, (
        arguments,
        pathlib.Path(log).read_text()[-2000:],
    )
    return time.monotonic() - start


def killed(arguments, log, moment):
    """Run a command and kill it after so many seconds; whether it was still at work."""
    pid = fork(arguments, log)
    time.sleep(moment)
    os.kill(pid, signal.SIGKILL)
    hit = os.WIFSIGNALED(os.waitpid(pid, 0)[1])
    print(
        f"{arguments[0]}: {'killed after' if hit else 'had ended by'} {moment:.2f} s",
        file=sys.stderr,
    )
    return hit


def records(run):
    return {p.name: p.read_bytes() for p in (run / "cells").rglob("*.json")}


def state(run):
    """All of a run but what was measured in seconds."""
    from attnwarp_eval.study.store import Store

    store = Store(run)
    cells = [store.read(cell) for cell in sorted(store.done())]
    plain = [{k: v for k, v in cell.items() if k not in ("cost", "sha256")} for cell in cells]
    names = [
        p for p in run.rglob("*") if p.is_file() and "cells" not in p.parts and p.name != ".lock"
    ]
    return plain, {str(p.relative_to(run)): p.read_bytes() for p in names}


def main(kills, folder, seed=0):
    """Half of the kills hit the run, a quarter the report, a quarter the comparison and its baseline."""
    import attnwarp_eval.compare
    import attnwarp_eval.compare.pictures
    import attnwarp_eval.compare.write
    import attnwarp_eval.report
    import attnwarp_eval.study.run  # noqa: F401

    rng = random.Random(seed)
    folder.mkdir(parents=True, exist_ok=True)
    os.chdir(folder)
    pathlib.Path("study.yaml").write_text(STUDY)
    log = "log"
    run, report = ["run", "study.yaml", "--out"], ["report", "--no-timings"]
    # What is right: each command once, undisturbed. The first run fills the cache of derived files.
    whole([*run, "right"], log)
    shutil.rmtree("right")
    seconds = whole([*run, "right"], log)
    seconds_report = whole([*report, "right"], log)
    right = state(pathlib.Path("right"))
    update = ["compare", "right.jsonl", "right", "--update"]
    compare = [
        "compare",
        "right.jsonl",
        "right",
        "--html",
        "c.html",
        "--json",
        "c.json",
        "--markdown",
        "c.md",
    ]
    seconds_update, seconds_compare = whole(update, log), whole(compare, log)
    compared = [
        "right.jsonl",
        "c.html",
        "c.json",
        "c.md",
        *map(str, sorted(pathlib.Path("right.pictures").rglob("*.jpg"))),
    ]
    outcome = {name: pathlib.Path(name).read_bytes() for name in compared}
    assert len(outcome) > 4

    hits = {"run": 0, "report": 0, "compare": 0}
    run_folder = pathlib.Path("killed")
    while hits["run"] < kills - 2 * (kills // 4):
        before = records(run_folder)
        hit = killed([*run, "killed"], log, rng.uniform(0, seconds))
        hits["run"] += hit
        after = records(run_folder)
        assert before.items() <= after.items(), "a finished cell was lost or changed"
        if not hit:  # it is complete: begin again
            whole([*report, "killed"], log)
            assert state(run_folder) == right
            shutil.rmtree(run_folder)
    whole([*run, "killed"], log)
    while hits["report"] < kills // 4:
        hits["report"] += killed([*report, "killed"], log, rng.uniform(0, seconds_report))
    whole([*report, "killed"], log)
    assert state(run_folder) == right
    while hits["compare"] < kills // 4:
        hits["compare"] += killed(update, log, rng.uniform(0, seconds_update))
        if hits["compare"] < kills // 4:
            whole(update, log)
            hits["compare"] += killed(compare, log, rng.uniform(0, seconds_compare))
    whole(update, log)
    whole(compare, log)
    assert {name: pathlib.Path(name).read_bytes() for name in compared} == outcome
    assert not list(pathlib.Path().rglob(".*.tmp"))
    print(
        f"{sum(hits.values())} kills ({hits}), nothing lost, the same bytes; "
        f"undisturbed: run {seconds:.1f} s, report {seconds_report:.1f} s, compare {seconds_compare:.1f} s"
    )


def in_a_process(kills, folder, seed=0):
    """``main`` in a process of its own, as forks of one with threads may hang."""
    environment = {**os.environ, "GIT_DIR": "/nonexistent"}
    command = [sys.executable, __file__, str(kills), str(folder), str(seed)]
    return subprocess.run(command, env=environment, capture_output=True, text=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), pathlib.Path(sys.argv[2]), *map(int, sys.argv[3:]))
