"""Logs of one's own measurements: rows of any reader -> Recording, truth, summary, check and picture."""
