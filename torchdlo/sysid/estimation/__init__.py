"""Estimation of parameters: least squares, worker processes, stored results."""
