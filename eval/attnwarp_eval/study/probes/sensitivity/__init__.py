"""Sensitivity of metrics to flaws of an edit."""
