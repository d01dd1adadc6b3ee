"""A survey of files: what our readers make of them, and what independent readers do."""
