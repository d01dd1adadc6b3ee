"""Experiments about the instrument itself: what truth costs, and what effects of light change."""
