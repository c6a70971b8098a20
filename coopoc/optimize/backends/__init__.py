"""One file per solver; each has a BACKEND whose `prepare(structure, **options)` returns a solver."""
