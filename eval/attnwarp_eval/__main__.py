"""`python -m attnwarp_eval` is the command attnwarp-eval."""

from attnwarp_eval.cli.main import main

main()
