"""What shared weights give away, and what can be done about it."""
