"""Metrics of a user's images."""
