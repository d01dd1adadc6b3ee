"""Bundled probes, a folder each: ``measure.py`` measures, ``report.py`` shows.

Other code finds them by name, with :func:`attnwarp_eval.study.probe.probe`.
"""
