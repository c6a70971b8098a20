"""What a Track is worth: errors, consistency, bounds and intervals."""
