"""Oracles: cards written out."""

from training.assess.card_sections import asked_for, percent, short_of, with_section
from training.assess.figures import Figure


def test_a_section_replaces_the_one_of_its_heading_and_leaves_the_others():
    card = "# small\n\nWords.\n\n## First\n\n| a |\n\nShort of: a.\n\n## Second\n\nMore.\n"
    added = with_section(card, "## Third\n\nNew.")
    assert added == card + "\n## Third\n\nNew.\n"
    replaced = "# small\n\nWords.\n\n## First\n\nOther.\n\n## Second\n\nMore.\n"
    assert with_section(card, "## First\n\nOther.\n") == replaced
    # A heading that another one begins with is another section.
    assert with_section(card, "## Fir\n\nNew.") == card + "\n## Fir\n\nNew.\n"
    assert with_section(added, "## Third\n\nNew.") == added


def test_figures_below_what_is_asked_or_above_what_is_allowed_are_named():
    figures = [
        Figure("low", 0.79, 0.7, 0.9, 100, asked=0.8),
        Figure("reached", 0.8, 0.7, 0.9, 100, asked=0.8),
        Figure("high", 0.16, 0.1, 0.2, 100, at_most=0.15),
        Figure("allowed", 0.15, 0.1, 0.2, 100, at_most=0.15),
        Figure("free", 0.0, 0.0, 0.1, 100),
    ]
    assert short_of(figures) == ["", "Short of what was asked for: low; high."]
    assert short_of(figures[1::2]) == []
    asked = [asked_for(figure) for figure in figures]
    assert asked == ["80 %", "80 %", "at most 15 %", "at most 15 %", ""]


def test_a_miss_that_rounds_to_its_limit_shows_more_digits():
    shown = [
        percent(Figure("high", 41 / 272, 0.1, 0.2, 272, at_most=0.15)),
        percent(Figure("low", 0.8463, 0.7, 0.9, 1000, asked=0.85)),
        percent(Figure("clearly low", 0.79, 0.7, 0.9, 100, asked=0.85)),
        percent(Figure("reached", 0.852, 0.7, 0.9, 100, asked=0.85)),
    ]
    assert shown == [
        "**15.1 %** (10 to 20)", "**84.6 %** (70 to 90)", "**79 %** (70 to 90)", "**85 %** (70 to 90)",
    ]  # fmt: skip
