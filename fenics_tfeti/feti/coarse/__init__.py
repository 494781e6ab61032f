"""The natural coarse space: G, projectors, coarse factors, body motions, the feasible start."""
