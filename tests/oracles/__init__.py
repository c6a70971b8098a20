"""One dense textbook implementation per method, written from its equations: the referees of the compiled kernels."""
