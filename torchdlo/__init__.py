"""Differentiable simulation of ropes, cables and wires in PyTorch."""

__version__ = "0.1.0"
