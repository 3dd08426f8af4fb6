"""Rigid bodies: dynamics, signed distances, contact among them."""
