"""Names from elsewhere in documents. Oracle: an HTML parser on what Python-Markdown makes of them."""

from html.parser import HTMLParser

import markdown as python_markdown

from attnwarp_eval.document.model import Report, Section, Table
from attnwarp_eval.document.write import markdown, page

NAMES = ("|x|", "<b>", "<script>alert(1)</script>", "</td>", "<!--x", "a < b")


class Parsed(HTMLParser):
    """The tags and the visible text of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text = [], ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)

    def handle_comment(self, data):
        self.tags.append("comment")

    def handle_data(self, data):
        self.text += data


def report(name):
    table = Table(["variant", name], [[name, "1"], ["other", "2"]], caption=f"of {name}")
    return Report(f"title {name}", [f"lead {name}"], [Section(name, [f"text {name}"], [table])])


def test_names_are_text_and_never_markup_or_columns(tmp_path):
    plain = python_markdown.markdown(markdown(report("plain")), extensions=["tables"])
    for name in NAMES:
        html = Parsed(python_markdown.markdown(markdown(report(name)), extensions=["tables"]))
        assert html.tags == Parsed(plain).tags, name
        assert html.text.count(name) == 7, name
        assert (
            Parsed(page(report(name), tmp_path)).tags
            == Parsed(page(report("plain"), tmp_path)).tags
        )
