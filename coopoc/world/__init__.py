"""What happens on the road, and what vehicles may see of it."""
