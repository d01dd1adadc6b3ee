"""Extension of griffe: a docstring's ``Example:`` is shown as code, as ``Examples:`` would be."""

from __future__ import annotations

import re
from typing import Any

import griffe


class ShowExamples(griffe.Extension):
    """Rename the sections, whose name Google's style has in the plural alone."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rename those of one module, class or function, as soon as it is read."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(
                r"^Example:$", "Examples:", obj.docstring.value, flags=re.MULTILINE
            )
