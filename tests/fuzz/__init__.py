"""Fuzzing of the text readers: good files, the contract of a reader, coverage-guided runs and their finds."""
