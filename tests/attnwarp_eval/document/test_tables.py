"""Tables as files. Oracles: LaTeX's own table of special characters (The LaTeX Companion, 2.1), the csv module."""

import csv

import pytest

from attnwarp_eval.document.model import Report, Section, Table
from attnwarp_eval.document.tables import latex_table, latex_text, write_tables

HOSTILE = Table(
    ["variant", "a|b, %"],
    [["[0, 1] & more", "`x_1` ± 5 %"], ['say "so"\nagain', "**2**\\3 {#} ~ ^ $4 < 5"]],
    "Odd & ends",
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("50 % & $3 #1", r"50 \% \& \$3 \#1"),
        ("a_b {c}", r"a\_b \{c\}"),
        ("~ ^ \\", r"\textasciitilde{} \textasciicircum{} \textbackslash{}"),
        ("a < b > c", "a $<$ b $>$ c"),
        ("`shared: a_b`, **2.0**", r"\texttt{shared: a\_b}, \textbf{2.0}"),
        ("3.1 ± 0.2 × 4°", r"3.1 $\pm$ 0.2 $\times$ 4$^\circ$"),
        ("two\nlines", "two lines"),
    ],
)
def test_what_latex_gives_a_meaning_is_written_as_its_character(text, expected):
    assert latex_text(text) == expected


def test_a_table_of_latex_has_its_rows_and_no_row_begins_with_a_bare_bracket():
    lines = latex_table(HOSTILE, "Odd & ends, 5 %.").splitlines()
    assert r"\caption{Odd \& ends, 5 \%.}" in lines
    assert r"\begin{tabular}{ll}" in lines
    rows = [line for line in lines if line.endswith(r" \\")]
    assert rows[1] == r"{[}0, 1{]} \& more & \texttt{x\_1} $\pm$ 5 \% \\"
    # Outside of escapes there is one tab less than columns, and braces are even.
    for row in rows:
        bare = row.replace(r"\&", "").replace(r"\{", "").replace(r"\}", "")
        assert bare.count("&") == 1 and bare.count("{") == bare.count("}")


def test_every_table_has_a_file_with_its_title_and_what_it_was_measured_on(tmp_path):
    section = Section("Differences", tables=[HOSTILE, Table(["n"], [["1"]])])
    report = Report("r", [], [section], Section("Answer", tables=[Table(["a"], [["2"]])]))
    paths = write_tables(
        report, lambda table: f"{len(table.rows)} rows.", tmp_path / "tables", ("tex", "csv")
    )
    assert [path.name for path in paths[::2]] == [
        "01-answer.tex", "02-differences-odd-ends.tex", "03-differences.tex",
    ]  # fmt: skip
    caption, *rows = (tmp_path / "tables/02-differences-odd-ends.csv").read_text().splitlines()
    assert caption == "# Differences: Odd & ends. 2 rows."
    assert list(csv.reader(rows)) == [
        ["variant", "a|b, %"],
        ["[0, 1] & more", "x_1 ± 5 %"],
        ['say "so" again', "2\\3 {#} ~ ^ $4 < 5"],
    ]
