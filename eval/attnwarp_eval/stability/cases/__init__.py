"""The hard cases, by package of the library."""
