"""Keys of a study that several probes read, and what several measure with."""
