"""Linear algebra of a problem at a point: tapes of derivatives, normal equations, factors."""
