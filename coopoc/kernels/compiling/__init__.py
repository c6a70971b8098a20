"""How kernels are compiled, and the arithmetic that all of them use."""
