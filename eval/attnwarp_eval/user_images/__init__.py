"""The metrics on a person's own images."""
