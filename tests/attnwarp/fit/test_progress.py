"""What a person sees of a fit."""

import io
import math

import pytest
from rich.console import Console

from attnwarp.fit import Step
from attnwarp.fit.progress import describe, progress_display


def step(iteration, **changes):
    values = {"loss": 0.0374, "psnr": 33.912, "held_out": 33.2, "splats": 20000, "seconds": 12.0}
    return Step(iteration=iteration, iterations=3000, **{**values, **changes})


def test_a_step_is_described_by_its_loss_and_psnr():
    assert describe(step(1)) == "loss 0.0374, PSNR 33.91 dB, held out 33.20 dB, 20000 splats"
    assert (
        describe(step(1, psnr=math.inf, held_out=None)) == "loss 0.0374, PSNR inf dB, 20000 splats"
    )


def test_an_older_evaluation_is_named_by_its_iteration():
    assert describe(step(900, evaluated=500)).split(", ")[2] == "held out 33.20 dB at 500"
    assert describe(step(500, evaluated=500)).split(", ")[2] == "held out 33.20 dB"


def test_without_a_terminal_there_are_plain_lines_now_and_then():
    text = io.StringIO()
    with progress_display(Console(file=text, force_terminal=False), title="bear") as watch:
        for k in range(1, 3001):
            watch(step(k))
    # 3000 steps in an instant: none but the last is worth a line.
    assert text.getvalue() == f"bear [3000/3000] 12 s: {describe(step(3000))}\n"


@pytest.mark.parametrize("width", [80, 140])
def test_on_a_terminal_the_counts_keep_their_digits(width):
    text = io.StringIO()
    console = Console(file=text, force_terminal=True, width=width, color_system=None)
    with progress_display(console, title="bear") as watch:
        watch(step(2999))
        watch(step(3000))
    assert (
        "3000/3000" in text.getvalue()
        and "loss 0.0374" in text.getvalue()
        and "…" not in text.getvalue()
    )
