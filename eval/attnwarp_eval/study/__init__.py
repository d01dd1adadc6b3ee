"""Studies: scenes x variants x seeds x probes, run as content-addressed cells that survive any
interruption.
"""

from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.schema import Study, StudyError
from attnwarp_eval.study.store import Store
from attnwarp_eval.study.study import cells_of, load_study, parse_study

__all__ = ["Cell", "Store", "Study", "StudyError", "cells_of", "load_study", "parse_study"]
