"""The paper's tables from a manifest: captures, splats, words, methods and weights of one's own.

``manifest`` reads it, ``check`` refuses what does not fit before anything runs, ``cells`` edits and
measures, ``estimate`` tells what that costs, ``report`` writes the tables, ``seal`` hashes it all.
"""
