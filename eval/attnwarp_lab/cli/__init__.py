"""Commands of the laboratory, by their names."""

from attnwarp_eval.cli.shell import OTHER_RUNS
from attnwarp_lab.cli import captures, userstudy

COMMANDS = {"captures": captures.captures, "userstudy": userstudy.app}
"""Entry point of the group ``attnwarp_eval.commands``."""

OTHER_RUNS["seal.json"] = "attnwarp_lab.captures.seal"
