"""Hand-made runs: records written as JSON, read as a report reads them."""

import copy
import tarfile
from pathlib import Path

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
        spec: spec of the cell.
        environment: where it was computed.
        cost: entries of the cost that matter.
        extra: entries that only the probe's records hold.
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


def unpack_stored(folder):
    """Put the stored run, which report/test_stored_runs.py describes, into a folder."""
    data = Path(__file__).parents[1] / "attnwarp_eval" / "data" / "runs.tar.xz"
    with tarfile.open(data) as archive:
        # Python 3.11.3 and before have no filters.
        archive.extraction_filter = getattr(tarfile, "data_filter", None)
        archive.extractall(folder)
    return folder
