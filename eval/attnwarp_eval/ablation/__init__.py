"""Studies: scenes x variants x seeds x probes, run as content-addressed cells that survive any interruption."""

from attnwarp_eval.ablation.cell import Cell
from attnwarp_eval.ablation.store import Store
from attnwarp_eval.ablation.study import Study, StudyError, load_study

__all__ = ["Cell", "Store", "Study", "StudyError", "load_study"]
