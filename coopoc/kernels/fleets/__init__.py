"""Whole fleets: filters, smoothers and algorithms that iterate over messages."""
