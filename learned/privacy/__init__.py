"""Differential privacy, secure aggregation, and membership inference as an attack on shared weights."""
