"""Studies, one file each: a grid, its settings, and the tables, figures and findings that answer a question."""
