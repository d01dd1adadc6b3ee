"""Benchmarks that a person can run; no part of the library."""
