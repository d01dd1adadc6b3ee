"""The benchmark of editing: its ratios against sums done by hand."""

from pathlib import Path

from benchmarks.editing import ratio_table, table


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


def test_a_row_of_the_table_adds_fit_and_edit_and_says_what_they_held_in_memory():
    row = {
        "name": "default", "iterations": 3000, "splats": 30_000, "tuning": 300, "held_out": 33.0,
        "fit": {"cpu": 300.0, "wall": 200.0}, "edit": {"cpu": 150.0, "wall": 100.0},
        "edit_psnr": 22.5, "views": [64, 256, 128], "peak_mb": 3072.0, "curve": [],
    }  # fmt: skip
    lines = table([row], Path("bear"), 0.5).splitlines()
    head, ruler, first = lines[4:7]
    assert head.count("|") == ruler.count("|") == first.count("|")
    cells = [cell.strip() for cell in first.split("|")[1:-1]]
    assert cells[5:] == ["300", "150", "450", "300", "64, 256 x 128", "3.00"]
    unedited = table([{k: v for k, v in row.items() if k != "edit"}], Path("bear"), 0.5)
    assert unedited.splitlines()[6].count("|") == head.count("|")
