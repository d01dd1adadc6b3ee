"""Study keys and helpers shared by several probes."""
