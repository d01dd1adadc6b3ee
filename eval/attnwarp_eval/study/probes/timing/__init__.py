"""Seconds of variants taken in turn in one process."""
