"""Sums and factors of graphs: tapes, sparse Cholesky, selected inversion, normal equations."""
