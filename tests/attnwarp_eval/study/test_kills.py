"""SIGKILL at random moments of the run, the report and the comparison. Oracle: the same commands, undisturbed."""

import killing
import pytest


@pytest.mark.slow
def test_killed_at_random_moments_and_started_again_every_command_gives_the_same_bytes(tmp_path):
    done = killing.in_a_process(12, tmp_path / "killed")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("12 kills")
