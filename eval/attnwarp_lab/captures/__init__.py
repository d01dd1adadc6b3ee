"""Methods on captures, by a manifest: the paper's tables, or one capture from a command line.

``manifest`` reads manifests, ``check`` refuses invalid inputs before anything runs, ``cells`` edits
and measures, ``estimate`` predicts the cost, ``report`` writes the tables, ``seal`` hashes the run.
"""
