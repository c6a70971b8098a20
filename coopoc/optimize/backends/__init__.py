"""One file per solver; each has build(problem, **options) -> Run."""
