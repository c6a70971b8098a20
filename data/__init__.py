"""Datasets: the registry, the readers and the bundled fleets."""
