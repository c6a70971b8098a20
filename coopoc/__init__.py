"""Optimization-based cooperative localization with learned-gain comparisons."""
