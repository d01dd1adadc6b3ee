"""Hard cases swept over their hardness."""
