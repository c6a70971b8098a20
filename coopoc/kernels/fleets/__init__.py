"""Whole fleets: filters and smoothers."""
