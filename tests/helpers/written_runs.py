"""Hand-made runs: records written as JSON, read as a report reads them."""

import copy

from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.results import Outcome, Results
from attnwarp_eval.study.study import parse_study

ENVIRONMENT = {
    "versions": {"python": "3"},
    "machine": {"system": "Linux", "arch": "x", "cores": 2},
    "git": {"sha": "a" * 40, "dirty": False},
    "source": "0" * 64,
}

TRANSPORT = {
    "needed": {"direct": "lights[0] is a sun"},
    "not_simulated": {},
    "plan": {"integrator": "path", "sensor": {"type": "perspective"}, "reasons": []},
    "everything_on": "volpath",
    "variant": "scalar_rgb",
}


def record(views, *, spec=None, environment=ENVIRONMENT, cost=None, **extra):
    """The JSON of a record.

    Args:
        views: (name, yaw, figures) each.
        spec: of the cell.
        environment: where it was computed.
        cost: entries of the cost that matter.
        extra: what only the probe's records hold.
    """
    return {
        "id": "",
        "spec": spec or {},
        "views": [{"view": name, "yaw": yaw, "metrics": figures} for name, yaw, figures in views],
        "pictures": [],
        "cost": {
            "seconds": {},
            "counters": {},
            "peak_memory_mb": 1.0,
            "threads": 1,
            **(cost or {}),
        },
        "environment": copy.deepcopy(environment),
        **extra,
    }


def outcome(kind, scene, variants, data, cell_id="", seed=0):
    """An expected cell of probe ``kind``; ``data`` is its record's JSON or None."""
    if data is not None and kind == "calibration":
        data = {"effects": TRANSPORT, **data}
    typed = None if data is None else probe(kind).read(data)
    return Outcome(cell_id or f"{kind}-{scene}", kind, scene, tuple(variants), kind, seed, typed)


def results(study, cells):
    """The run of a study, given as plain data."""
    return Results(parse_study(study), cells, [])
