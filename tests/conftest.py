import functools
import os

import pytest

_WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if _WORKERS > 1:
    # Read by torch when it is first imported, and by every child process: workers share the cores
    # rather than each taking all of them.
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, len(os.sched_getaffinity(0)) // _WORKERS)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Files whose tests share a fixture, or scenes and their textures in the memory of a process, run
    in one worker, so that these are made once, and run first; every other test goes to whichever
    worker is free.

    xdist's own ``--dist loadgroup`` does this with marks, but has no effect with pytest 9.2, where
    a test's id cannot be changed.
    """
    from xdist.scheduler import LoadScopeScheduling

    @functools.cache
    def shares(path):
        if path.startswith("tests/attnwarp_eval/"):
            return True
        return 'scope="module"' in (config.rootpath / path).read_text()

    class Scheduler(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            path = nodeid.partition("::")[0]
            return path if shares(path) else nodeid

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
