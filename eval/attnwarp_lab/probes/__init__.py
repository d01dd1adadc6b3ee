"""Plugin of the laboratory: hard cases, the ideal editor of a bench, probes."""

from attnwarp_eval.bench import EDITORS
from attnwarp_eval.stability import ROOMS
from attnwarp_eval.study.probe import import_probes

import_probes(__name__)
ROOMS.append("attnwarp_lab.ideal.hard_cases")
EDITORS["ideal"] = "attnwarp_lab.ideal.bench:bench_editor"
