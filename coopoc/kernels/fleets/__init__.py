"""Whole fleets: filters."""
