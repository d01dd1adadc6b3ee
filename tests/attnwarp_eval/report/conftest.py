import pathlib

import pytest

from attnwarp_eval.report import claims


@pytest.fixture
def slip_declared(monkeypatch):
    """The family of claims is one on a slip by half a pixel, which a study 'suite' judges."""
    path = pathlib.Path(__file__).parents[1] / "data/claims.yaml"
    monkeypatch.setattr(claims, "DECLARED", path)
    claims.load_claims.cache_clear()
    yield
    claims.load_claims.cache_clear()
