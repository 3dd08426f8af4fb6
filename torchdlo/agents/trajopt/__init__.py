"""Trajectory optimisation on tasks: CMA-ES, gradient descent, hybrid."""
