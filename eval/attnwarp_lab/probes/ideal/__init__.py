"""Edits in parts by the ideal editor."""
