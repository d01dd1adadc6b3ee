"""The command line."""

from attnwarp_eval.cli.main import main

__all__ = ["main"]
