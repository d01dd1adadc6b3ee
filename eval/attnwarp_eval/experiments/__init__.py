"""Experiments about the instrument itself: what truth costs, what optical flow misses, how long the
suite takes.
"""
