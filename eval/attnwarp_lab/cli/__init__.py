"""Commands of the laboratory, by their names."""

from attnwarp_lab.cli import captures, userstudy

COMMANDS = {"captures": captures.captures, "userstudy": userstudy.app}
"""Entry point of the group ``attnwarp_eval.commands``."""
