"""Edits that change shapes by the ideal editor."""
