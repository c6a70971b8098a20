"""Compiled kernels: the same answers as the NumPy code that they stand beside, in machine code, float64."""
