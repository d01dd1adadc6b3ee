"""`python -m attnwarp_eval` is the command attnwarp-eval, and its entry point."""

from attnwarp.cli.entry import enter


def main() -> None:
    """Run the command attnwarp-eval."""
    enter("attnwarp-eval", "attnwarp_eval.cli.main")


if __name__ == "__main__":
    main()
