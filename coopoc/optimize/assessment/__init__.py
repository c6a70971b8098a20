"""What a point is worth, whoever found it: cost, covariance, curvature, what constraints hold."""
