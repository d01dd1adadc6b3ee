"""Statistics: intervals, paired differences, corrections for several tests."""
