"""Plugin of the laboratory: its hard cases, and its probes, a module or a folder each."""

from attnwarp_eval.stability import ROOMS
from attnwarp_eval.study.probe import import_probes

import_probes(__name__)
ROOMS.append("attnwarp_lab.ideal.hard_cases")
