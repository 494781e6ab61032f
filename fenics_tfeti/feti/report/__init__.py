"""The figures of a solve, and the forces and moments of its solution."""
