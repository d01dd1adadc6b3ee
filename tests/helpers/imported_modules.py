"""Imports of a piece of code, from the modules of a fresh process."""

import subprocess
import sys


def modules_after(code, *further):
    """Names in ``sys.modules`` at the end of ``code``, which prints nothing; of several pieces, a
    set after each of them, from one process.
    """
    pieces = (code, *further)
    program = "\n".join(f"{piece}\nimport sys\nprint(*sys.modules)" for piece in pieces)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=True
    )
    sets = [set(line.split()) for line in done.stdout.splitlines()]
    return sets if further else sets[0]
