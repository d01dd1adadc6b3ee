"""The benchmark of editing: its ratios against sums done by hand."""

from benchmarks.editing import ratio_table


def test_the_ratio_is_the_median_of_ratios_within_rounds_without_tuning() -> None:
    one = [
        {"source": s, "edit": 3 * s, "write": s, "tune": 99.0, "network_rows": 8} for s in (1, 2, 4)
    ]
    # 1.1, 1.3 and 1.2 times the editing of the same round; with files 2.36, 2.68 and 2.52 times.
    carried = [
        {"source": s, "warp": share * s, "edit": 3 * s, "write": s * (7 + share), "network_rows": 8}
        for s, share in ((1, 0.4), (2, 1.2), (4, 0.8))
    ]
    again = [{**row, "edit": row["edit"] + 0.4 * row["source"]} for row in carried]
    text = ratio_table({"propagation": carried, "again": again, "one by one": one}, 0.5)
    lines = text.splitlines()
    editing = next(line for line in lines if line.startswith("| editing |"))
    assert "1.20 (1.10 to 1.30)" in editing
    # To itself: 4.8 / 4.4, 5.6 / 5.2 and 5.2 / 4.8.
    assert "1.08 (1.08 to 1.09)" in editing
    assert "| source | 2.000 | 2.000 |" in text
    files = next(line for line in lines if line.startswith("| editing and files |"))
    assert "2.52 (2.36 to 2.68)" in files
    assert "Rows through the network: 8 and 8. 3 rounds" in text
