"""Studies: scenes x variants x seeds x probes, run as content-addressed cells that survive any
interruption.
"""

from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.store import Store
from attnwarp_eval.study.study import Study, StudyError, load_study

__all__ = ["Cell", "Store", "Study", "StudyError", "load_study"]
