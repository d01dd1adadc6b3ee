"""Methods on captures, by a manifest: the paper's tables, or one capture of a command line.

``manifest`` reads it, ``check`` refuses what does not fit before anything runs, ``cells`` edits and
measures, ``estimate`` tells what that costs, ``report`` writes the tables, ``seal`` hashes it all.
"""
