import functools
import gc
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer.testing
from all_reported import pytest_runtest_logreport, pytest_sessionfinish  # noqa: F401  (hooks)

ROOT = Path(__file__).parent

# A background job of a shell ignores Ctrl-C, and so would every process that a test starts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# As in the commands' own entry: idle threads of OpenMP sleep rather than spin.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
_WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if _WORKERS > 1:
    # Read by torch when it is first imported, and by every child process: workers share the cores
    # rather than each taking all of them.
    _affinity = getattr(os, "sched_getaffinity", None)  # not on macOS
    _cores = len(_affinity(0)) if _affinity else os.cpu_count() or 1
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, _cores // _WORKERS)))

# A test calls a command many times; its options are read from the function's signature once.
typer.testing._get_command = functools.cache(typer.testing._get_command)


@pytest.fixture(autouse=True)
def stops_are_forgotten():
    """A stop that a test raises in this process is remembered (process.interrupted), and errors of
    the next test's command would be taken for its consequence.
    """
    yield
    if process := sys.modules.get("attnwarp.process"):
        process.interrupted = False


@pytest.fixture
def clock(monkeypatch):
    """The seconds that progress reads, which a test sets."""
    import attnwarp.reporting

    now = SimpleNamespace(seconds=0.0)
    fake = SimpleNamespace(perf_counter=lambda: now.seconds)
    monkeypatch.setattr(attnwarp.reporting, "time", fake)
    return now


@pytest.fixture(scope="module")
def coarse_textures():
    """Textures baked for pictures of 160, not 512 rows, which takes a tenth of the time."""
    from attnwarp_eval.truth.mitsuba import build

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "TEXELS", 640)
        build.forget()
        yield
        build.forget()


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Imports make a million objects that stay: looking through them for cycles, again and again as
    they grow, takes an eighth of the collection's time.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()


SLOW_LIMIT = 1800
"""Seconds that a slow test may take; every other has the limit of pyproject.toml."""


def pytest_collection_modifyitems(items):
    """Mark tests by their place, and give slow tests more time."""
    for item in items:
        room = item.path.relative_to(ROOT).parts[0]
        if room in {"training", "scripts"}:
            item.add_marker(room)
        if any(item.iter_markers("slow")) and not any(item.iter_markers("timeout")):
            item.add_marker(pytest.mark.timeout(SLOW_LIMIT))


@pytest.fixture(autouse=True, scope="session")
def derived_files_of_this_run(tmp_path_factory):
    """Derived files go to a folder of this run's own, which its workers share, so that no test
    passes by what an earlier run left behind and each file is computed once.
    """
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ATTNWARP_CACHE", str(folder / "derived"))
        yield
