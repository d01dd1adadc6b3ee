"""The hard cases, by room of the library."""
