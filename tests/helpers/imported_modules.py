"""Imports of a piece of code, from the modules of a fresh process."""

import subprocess
import sys


def modules_after(code):
    """Names in ``sys.modules`` at the end of ``code``, which prints nothing."""
    program = f"{code}\nimport sys\nprint('\\n'.join(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=True
    )
    return set(done.stdout.split())
