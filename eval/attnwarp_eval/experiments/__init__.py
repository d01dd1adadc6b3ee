"""Experiments about the instrument itself: what truth costs, what effects of light change, how long
the suite takes.
"""
