"""Coupling of ropes with rigid bodies, grippers and particles."""
