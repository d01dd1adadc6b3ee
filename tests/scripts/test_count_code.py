"""Lines that ``make count`` counts."""

from __future__ import annotations

from scripts.count_code import code_lines


def test_docstrings_comments_and_blank_lines_are_no_code():
    text = '''"""A module.

Of three lines."""

# A reason.
LIMIT = 3
"""A string below an assignment counts, as Python does not take it for a docstring."""


class Box:
    """A class."""

    def side(self) -> int:
        """A function."""
        text = """a string
        of two lines"""
        return len(text)  # a comment behind code
'''
    # By hand: LIMIT, the string below it, class, def, text's two lines, return.
    assert code_lines(text) == 7
