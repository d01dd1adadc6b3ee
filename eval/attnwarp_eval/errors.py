"""The one kind of error that is a person's to mend: the command line shows its message and exits with code 2."""


class InputError(ValueError):
    """An input that cannot be used. The message names the file, what came, what was expected, and the remedy."""
