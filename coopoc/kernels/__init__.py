"""Compiled kernels: the mathematics of every method, in machine code and float64; tests hold them against oracles."""
