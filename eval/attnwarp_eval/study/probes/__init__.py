"""Probes: what a study can measure."""
