"""Studies of people: a page of two-way choices between edited scenes, and the answers' score."""
