"""Seconds of whole edits taken in turn in one process."""
