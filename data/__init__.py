"""Datasets: the registry, the readers, the generator and the bundled fleets."""
