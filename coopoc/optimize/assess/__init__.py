"""Assessment of a point independently of its solver: cost, covariance, curvature, active constraints."""
