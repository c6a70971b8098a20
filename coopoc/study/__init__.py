"""Studies: a grid of cells, its results, tables, figures and report."""
