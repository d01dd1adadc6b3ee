"""The commands about scenes: what is wrong with an option is one line and exit code 2."""

import pytest
from typer.testing import CliRunner

from attnwarp_eval.cli.main import app


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["render", "opposed", "--views", ","], "views: got none, expected names of cameras"),
    ],
)
def test_a_value_that_makes_no_sense_is_told_in_a_line(tmp_path, arguments, says):
    done = CliRunner().invoke(
        app,
        ["scenes", *(a.format(out=tmp_path / "out") for a in arguments)],
        catch_exceptions=False,
    )
    assert done.exit_code == 2 and says in done.stderr
