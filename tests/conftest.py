import functools
import os
import signal
from pathlib import Path

import pytest
import typer.testing

ROOT = Path(__file__).parent

# A background job of a shell ignores Ctrl-C, and so would every process that a test starts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

_WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if _WORKERS > 1:
    # Read by torch when it is first imported, and by every child process: workers share the cores
    # rather than each taking all of them.
    _affinity = getattr(os, "sched_getaffinity", None)  # not on macOS
    _cores = len(_affinity(0)) if _affinity else os.cpu_count() or 1
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, _cores // _WORKERS)))

# A test calls a command many times; its options are read from the function's signature once.
typer.testing._get_command = functools.cache(typer.testing._get_command)


@pytest.fixture(scope="module")
def coarse_textures():
    """Textures baked for pictures of 160, not 512 rows, which takes a tenth of the time."""
    from attnwarp_eval.truth.mitsuba import build

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "TEXELS", 640)
        build.forget()
        yield
        build.forget()


# Files that take a worker 10 s and more, longest first. They begin the run, as one of them at its
# end would leave the other workers without work.
LONGEST = [
    "attnwarp_eval/study/test_run.py",
    "attnwarp_eval/effects/test_detect.py",
    "attnwarp_eval/scene/test_suite.py",
    "attnwarp_eval/effects/test_proof.py",
    "attnwarp/encoders/test_bundled.py",
    "attnwarp_eval/truth/test_mitsuba.py",
    "attnwarp/test_cli.py",
    "attnwarp_eval/truth/test_edits.py",
    "attnwarp_eval/effects/test_table.py",
    "attnwarp_eval/truth/test_llvm.py",
]


@functools.cache
def _shares(path):
    """Whether the tests of a file share a fixture, or scenes and their textures in the memory of a
    process.
    """
    return path.is_relative_to(ROOT / "attnwarp_eval") or 'scope="module"' in path.read_text()


def pytest_collection_modifyitems(items):
    """For workers: the longest files first, then the files that share, then every other test."""
    if _WORKERS > 1:
        ranks = {ROOT / name: rank for rank, name in enumerate(LONGEST)}
        items.sort(key=lambda item: (ranks.get(item.path, len(ranks)), not _shares(item.path)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Files whose tests share something run in one worker, so that it is made once; every other test
    goes to whichever worker is free.

    xdist's own ``--dist loadgroup`` does this with marks, but has no effect with pytest 9.2, where
    a test's id cannot be changed.
    """
    from xdist.scheduler import LoadScopeScheduling

    config.option.loadscopereorder = False  # the order is that of pytest_collection_modifyitems

    class Scheduler(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            path = nodeid.partition("::")[0]
            return path if _shares(config.rootpath / path) else nodeid

    return Scheduler(config, log)


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
