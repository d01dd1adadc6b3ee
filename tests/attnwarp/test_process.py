"""The oracle is the interpreter's own count of what its collector leaves alone."""

import os
import subprocess
import sys

from attnwarp.process import core_count


def test_nothing_is_left_to_search_as_the_process_ends():
    code = (
        "import atexit, gc, sys; from attnwarp.process import skip_last_collection;"
        # Registered first, it runs last.
        "atexit.register(lambda: print(gc.get_freeze_count() > 0, len(gc.get_objects()) < 50));"
        "skip_last_collection(); print(gc.get_freeze_count(), 'numpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "False", "True", "True"]


def test_cores_are_those_that_this_process_may_use(monkeypatch):
    cores = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(cores)})
        assert core_count() == 1
    finally:
        os.sched_setaffinity(0, cores)
    assert core_count() == len(cores)
    # As on macOS.
    monkeypatch.delattr(os, "sched_getaffinity")
    assert core_count() == os.cpu_count()
