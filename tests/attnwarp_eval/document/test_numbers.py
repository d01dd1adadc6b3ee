"""Numbers of a document, beside what they round to by hand."""

import pytest

from attnwarp_eval.document.numbers import number


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (999.6, "1000"),
        (-999.9, "-1000"),
        (999.4, "999"),
        (9.994, "9.99"),
        (1.0, "1.00"),
        (12345.6, "12346"),
        (0.0000123, "1.23e-05"),
        (0, "0"),
        (0.012345, "0.0123"),
        (-2.5, "-2.50"),
        (1e-9, "1e-09"),
        (float("nan"), "–"),
        (None, "–"),
    ],
)
def test_a_number_has_three_digits_and_no_exponent_where_it_is_whole(value, text):
    assert number(value) == text


def test_fewer_digits_round_the_same_way():
    assert [number(x, 2) for x in (99.6, 99.4, 9.94)] == ["100", "99", "9.9"]
