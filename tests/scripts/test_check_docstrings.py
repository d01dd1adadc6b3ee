"""The lint of docstrings, on lines written by hand."""

import pytest

from scripts.check_docstrings import broken

LONG = (
    "A first line that is long enough, so that no word of the next one has room beside it, as here"
)


@pytest.mark.parametrize(("text", "lines"), [
    (f'"""{LONG}\nends.\n"""', []),
    ('"""Bundled editors: small, trained from scratch, read from\nweights/.\n"""', [1]),
    ('def f():\n    """Sum.\n\n    Two numbers are added\n    here.\n    """', [4]),
    ('def f():\n    """Sum.\n\n    Args:\n        a: one number\n        b: other one.\n    """', []),
    ('"""Run it. ::\n\n    python -m one\n    python -m two\n"""', []),
    ('"""Files:\n\na.png   a picture\nb.png   another\n"""', []),
])  # fmt: skip
def test_a_line_that_a_reflow_broke_is_found_and_no_table_or_code(text, lines):
    assert [line for line, _ in broken(text)] == lines
