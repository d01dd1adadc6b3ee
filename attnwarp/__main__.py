"""`python -m attnwarp` is the command attnwarp."""

from attnwarp.cli.main import main

main()
