"""Outer loops: from a start to a minimum."""
