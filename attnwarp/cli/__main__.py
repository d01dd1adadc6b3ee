"""``python -m attnwarp.cli``."""

from attnwarp.cli.main import main

main()
