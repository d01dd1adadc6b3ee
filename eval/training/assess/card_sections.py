"""Sections of an editor's card that commands of their own measure, and the results of a measurement that was stopped."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from attnwarp.io.file import write_atomically
from training.assess.figures import Figure


def with_section(card: str, section: str) -> str:
    """A card with a section; one of the same heading is replaced, another one stands at the end.

    Args:
        section: its first line is its heading, ``## ...``.
    """
    parts = [part.strip("\n") for part in re.split(r"(?m)^(?=## )", card)]
    headings = [part.split("\n", 1)[0] for part in parts]
    heading = section.split("\n", 1)[0]
    place = headings.index(heading) if heading in headings else len(parts)
    parts[place : place + 1] = [section.strip("\n")]
    return "\n\n".join(parts) + "\n"


def short_of(figures: Sequence[Figure]) -> list[str]:
    """Lines that name the figures that miss what was asked for; none where all meet it."""
    short = [f.what for f in figures if f.short]
    return ["", "Short of what was asked for: " + "; ".join(short) + "."] if short else []


def percent(f: Figure) -> str:
    """A figure with its interval, for a table; with decimals where a miss would look like the limit itself."""
    limit, digits = f.asked if f.at_most is None else f.at_most, 0
    while (
        f.short and limit is not None and digits < 3 and round(100 * (f.value - limit), digits) == 0
    ):
        digits += 1
    return f"**{100 * f.value:.{digits}f} %** ({100 * f.low:.0f} to {100 * f.high:.0f})"


def asked_for(f: Figure) -> str:
    """Requirement on a figure, for a table."""
    if f.at_most is not None:
        return f"at most {100 * f.at_most:.0f} %"
    return "" if f.asked is None else f"{100 * f.asked:.0f} %"


class Kept:
    """Results of a long measurement in a file, by name: one that was stopped goes on where it was.

    Args:
        path: path of the JSON; it names whatever the results depend on, such as the weights'
            checksum.
        say: shows the name of each result as it is computed; those that are read back are not told.
    """

    def __init__(self, path: Path, say: Callable[[str], object] = lambda name: None) -> None:
        self.path = path
        self.say = say
        self.results: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}

    def get(self, name: str, compute: Callable[[], Any]) -> Any:
        """The result of that name, computed and written if it is not there; it comes as JSON gives it back."""
        if name not in self.results:
            self.results[name] = json.loads(json.dumps(compute()))
            text = json.dumps(self.results)
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self.path, lambda stream: stream.write(text.encode()))
            self.say(name)
        return self.results[name]
