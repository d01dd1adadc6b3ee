"""The ideal editor: an editor of single views whose predictions are exact for given answers.

Its answers vary over a thing in parts, so that an edit shows whether features arrived at the right
place. It needs the true pictures of every answer. docs/measuring/ideal-editor.md describes what the
figures show.
"""
