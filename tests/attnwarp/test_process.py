"""The oracle is the interpreter's own count of what its collector leaves alone."""

import subprocess
import sys


def test_nothing_is_left_to_search_as_the_process_ends():
    code = (
        "import atexit, gc, sys; from attnwarp.process import skip_last_collection;"
        # Registered first, it runs last.
        "atexit.register(lambda: print(gc.get_freeze_count() > 0, len(gc.get_objects()) < 50));"
        "skip_last_collection(); print(gc.get_freeze_count(), 'numpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "False", "True", "True"]
