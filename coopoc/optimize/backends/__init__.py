"""One file per solver; each has a BACKEND with its `solver(problem, x, **options)`."""
