"""Experiments about the instrument itself: what truth costs."""
