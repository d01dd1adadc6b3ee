"""Studies: scenes x variants x seeds x probes, run as content-addressed cells that survive any
interruption. See docs/measuring/studies.md.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from attnwarp_eval.study.cell import Cell
    from attnwarp_eval.study.schema import Study, StudyError
    from attnwarp_eval.study.store import Store
    from attnwarp_eval.study.study import cells_of, load_study, parse_study

__all__ = ["Cell", "Store", "Study", "StudyError", "cells_of", "load_study", "parse_study"]

_MODULES = {
    "Cell": "cell",
    "Store": "store",
    "Study": "schema",
    "StudyError": "schema",
    "cells_of": "study",
    "load_study": "study",
    "parse_study": "study",
}


def __getattr__(name: str) -> Any:
    # Import on first use: scenes and probes import slowly, and `inspect` needs neither.
    if name in _MODULES:
        return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
