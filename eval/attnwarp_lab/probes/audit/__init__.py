"""Audit of consistency metrics on right edits and on flaws of known size."""
