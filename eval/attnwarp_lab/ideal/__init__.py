"""The ideal editor: an editor of single views whose every prediction is exact, for what it is told.

Its answers vary over a thing in parts, so that an edit shows whether features arrived where they
belong. It needs the true pictures of every answer. docs/measuring/ideal-editor.md tells what it can
say.
"""
