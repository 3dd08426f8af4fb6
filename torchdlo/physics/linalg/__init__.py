"""Banded systems, rotations and safe elementary functions."""
