"""Consistency metrics on right edits, and on flaws of known size: which can be believed."""
