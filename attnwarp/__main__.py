"""Entry point of `python -m attnwarp`, the command attnwarp."""

from attnwarp.cli.entry import enter


def main() -> None:
    """Run the command attnwarp."""
    enter("attnwarp", "attnwarp.cli.main")


if __name__ == "__main__":
    main()
