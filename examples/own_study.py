"""Measure what a mask buys on a scene of your choice: python examples/own_study.py [FOLDER]"""

import sys
from pathlib import Path

from attnwarp_eval.report import write_report
from attnwarp_eval.study import Store, parse_study
from attnwarp_eval.study.run import execute, plan

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/own")
study = parse_study(
    {
        "name": "own",
        "scenes": ["tiny"],
        "size": 48,
        "views": ["yaw030", "yaw060"],
        "variants": {"corrected": {}, "bounds only": {"set": {"depth_agreement": False}}},
        "probes": {"calibration": [], "warp": ["corrected", "bounds only"]},
    }
)
store = Store(folder)
summary = execute(plan(study, store), store)
write_report(store, timings=False, pictures=False)
print(f"{folder}/report.html: {summary.expected} cells, {len(summary.failures)} failed")
