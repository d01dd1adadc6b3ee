"""Backends of the renderer that tests run over."""

from __future__ import annotations

import pytest

GPU = pytest.param("gpu", marks=pytest.mark.slow)
"""Backend "gpu" on Warp's CPU device, in make test-all: its kernels are compiled for minutes where
no cache holds them, and run on one thread."""
