"""Oracles: cards written out."""

from training.card_sections import with_section


def test_a_section_replaces_the_one_of_its_heading_and_leaves_the_others():
    card = "# small\n\nWords.\n\n## First\n\n| a |\n\nShort of: a.\n\n## Second\n\nMore.\n"
    added = with_section(card, "## Third\n\nNew.")
    assert added == card + "\n## Third\n\nNew.\n"
    replaced = "# small\n\nWords.\n\n## First\n\nOther.\n\n## Second\n\nMore.\n"
    assert with_section(card, "## First\n\nOther.\n") == replaced
    # A heading that another one begins with is another section.
    assert with_section(card, "## Fir\n\nNew.") == card + "\n## Fir\n\nNew.\n"
    assert with_section(added, "## Third\n\nNew.") == added
