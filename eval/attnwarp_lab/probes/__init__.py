"""Probes of the laboratory: a plugin, and a module or a folder a probe."""

from attnwarp_eval.study.probe import import_probes

import_probes(__name__)
