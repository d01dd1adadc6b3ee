"""The benchmark against an earlier commit: its ratios against ratios done by hand."""

from benchmarks.before import table


def test_each_ratio_is_the_median_of_the_ratios_within_rounds():
    # CPU 0.5, 0.8 and 0.6 times, wall 0.25, 0.5 and 0.4 times; equal code 1.1 times.
    rounds = [
        [(old, old), (cpu * old, wall * old), (1.1 * old, old)]
        for old, cpu, wall in ((10.0, 0.5, 0.25), (20.0, 0.8, 0.5), (30.0, 0.6, 0.4))
    ]
    row = table({"fit": rounds}).splitlines()[2]
    assert [cell.strip() for cell in row.split("|")[1:-1]] == [
        "fit", "16.0", "10.0", "0.60 (0.50 to 0.80)", "0.40 (0.25 to 0.50)", "1.60",
        "1.10 (1.10 to 1.10)",
    ]  # fmt: skip
