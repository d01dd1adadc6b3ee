"""Commands of the laboratory, by their names."""

from attnwarp_lab.cli import userstudy

COMMANDS = {"userstudy": userstudy.app}
"""Entry point of the group ``attnwarp_eval.commands``."""
