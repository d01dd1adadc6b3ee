"""Calibration of the instrument."""
