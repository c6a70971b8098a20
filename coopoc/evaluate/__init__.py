"""Evaluation of a Track: errors, consistency, bounds and intervals."""
