"""Methods on captures, by a manifest: the paper's tables, or one capture from a command line.

``manifest`` reads manifests, ``cells`` checks their inputs, edits and measures, ``report`` writes
the table.
"""
