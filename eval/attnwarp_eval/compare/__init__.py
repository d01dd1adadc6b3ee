"""Comparison of a run with a baseline, to find regressions."""

from __future__ import annotations

from attnwarp_eval.compare.baseline import read_baseline, write_baseline
from attnwarp_eval.compare.judge import compare
from attnwarp_eval.compare.snapshot import Snapshot, read_snapshot

__all__ = ["Snapshot", "compare", "read_baseline", "read_snapshot", "write_baseline"]
