"""Names from elsewhere in documents, and pictures in pages. Oracles: an HTML parser on what
Python-Markdown makes of them, and on the page; OpenCV's decoder.
"""

import asyncio
import base64
import re
from html.parser import HTMLParser

import browser
import cv2
import markdown as python_markdown
import numpy as np
import pytest

from attnwarp_eval.document import charts
from attnwarp_eval.document.model import (
    Gallery,
    Marked,
    Picture,
    Report,
    Section,
    Slider,
    Table,
)
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


def test_an_error_of_several_lines_stays_in_its_cell():
    table = Table(["cell", "error"], [["a", "ValueError: x\n  at y\nz"], ["b", "none"]])
    text = markdown(Report("t", [], [Section("s", [], [table])]))
    parsed = Parsed(python_markdown.markdown(text, extensions=["tables"]))
    assert parsed.tags.count("tr") == 3 and parsed.tags.count("td") == 4
    assert all(word in parsed.text for word in ("ValueError: x", "at y", "z"))


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


def test_only_a_marked_cell_has_the_colour_of_its_verdict(tmp_path):
    table = Table(["figure"], [["no better"], [Marked("0.5 worse", "worse")]])
    text = page(Report("title", [], [Section("a", [], [table])]), tmp_path)
    assert re.findall(r"<td([^>]*)>([^<]*)", text) == [
        ("", "no better"),
        (' class="worse"', "0.5 worse"),
    ]


def test_a_page_holds_every_picture_and_nothing_from_elsewhere_in_8_mb(tmp_path):
    generator = np.random.default_rng(0)
    names = [f"{i}.jpg" for i in range(9)]
    for name in names:  # noise, which no format makes small
        noise = generator.integers(0, 256, (1024, 1024, 3), np.uint8)
        cv2.imwrite(str(tmp_path / name), noise, [cv2.IMWRITE_JPEG_QUALITY, 95])
    assert sum((tmp_path / name).stat().st_size for name in names) > 8_000_000
    with charts.drawing(tmp_path / "figure.svg") as (axes,):
        charts.hover(axes, 0.5, 0.5, "here")
    slider = Slider(Picture(names[0], "before"), Picture(names[1], "after"))
    rows = [("**bear, yaw030**", [Picture(name, name) for name in names[2:]])]
    text = page(
        Report(
            "title",
            [],
            [
                Section("a", figures=[Picture("figure.svg", "one"), Picture("figure.svg", "two")]),
                Section("b", gallery=Gallery([("", [slider]), *rows], picker=True)),
            ],
        ),
        tmp_path,
    )
    assert len(text.encode()) < 8_000_000
    images = re.findall(r'src="data:image/jpeg;base64,([^"]*)"', text)
    assert len(images) == len(names)
    for data in images:
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape[0] == picture.shape[1] > 500
    assert not re.search(r'(?:src|href)="(?:https?:)?//', text)
    assert text.count("<title>here</title>") == 2
    identities = re.findall(r'\bid="([^"]*)"', text)
    assert len(identities) == len(set(identities))
    assert set(re.findall(r'(?:href="|url\()#([^")]*)', text)) <= set(identities)


PLACES = """[...document.querySelectorAll('.scroll')].map((table) => {
    const row = table.querySelector('tbody tr').getBoundingClientRect();
    return [table.getBoundingClientRect().right, row.y + row.height / 2];
})"""


def test_a_table_that_is_cut_has_a_shadow_at_its_right_edge(tmp_path):
    if browser.executable() is None:
        pytest.skip("needs a Chromium (scripts/browser.sh)")
    wide = Table(["a", *(f"column {k}" for k in range(40))], [["x", *["1"] * 40]], caption="wide")
    narrow = Table(["a", "b"], [["x", "1"]], caption="narrow")
    path = tmp_path / "report.html"
    path.write_text(page(Report("title", [], [Section("s", [], [wide, narrow])]), tmp_path))

    async def look():
        async with browser.opened(path.as_uri()) as tab:
            await tab.until("document.querySelectorAll('.scroll').length == 2")
            edges = []
            for scrolled in (0, 1e6):
                await tab.run(f"document.querySelector('.scroll').scrollLeft = {scrolled}")
                image = (await tab.picture()).astype(int)
                for right, y in await tab.run(PLACES):
                    # The last pixels of a row against those beside the table.
                    row = image[int(y)]
                    edges.append(abs(row[int(right) - 2] - row[int(right) + 4]).max())
            return edges

    at_first, narrow_first, at_end, narrow_end = asyncio.run(look())
    assert at_first > 20 and max(narrow_first, at_end, narrow_end) < 5


def test_a_list_is_one_in_markdown_and_on_a_page(tmp_path):
    lines = "- a <b>name</b>\n- `code` - and a dash\n- last"
    report = Report("Lists", ["no - list", lines], [Section("Notes", [lines])])
    written = Parsed(python_markdown.markdown(markdown(report)))
    opened = Parsed(page(report, tmp_path))
    assert written.tags.count("ul") == opened.tags.count("ul") == 2
    assert written.tags.count("li") == opened.tags.count("li") == 6
    assert "b" not in opened.tags and "a <b>name</b>" in opened.text


def test_names_of_metrics_link_to_their_meaning(tmp_path):
    meanings = Table(["metric"], [["warp.epe"], ["depth.bias"]], glossary=True)
    used = Table(["metric"], [["warp.epe.64"], ["warp.other"], ["depth.bias"]])
    text = page(Report("title", [], [Section("a", [], [used, meanings])]), tmp_path)
    assert re.findall(r'<a href="#m-([^"]*)">([^<]*)<', text) == [
        ("warp.epe", "warp.epe.64"),
        ("depth.bias", "depth.bias"),
    ]
    assert '<tr id="m-warp.epe">' in text
