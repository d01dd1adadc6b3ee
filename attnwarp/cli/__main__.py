"""``python -m attnwarp.cli``."""

from attnwarp.cli.main import main

if __name__ == "__main__":
    main()
