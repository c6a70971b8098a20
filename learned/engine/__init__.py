"""GainNet compiled: the rollout, its backward pass, and the memory between the two."""
