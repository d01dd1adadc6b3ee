"""A bench for methods that live elsewhere: scenes as files, and scores of edited pictures."""
