"""Calibration of a rope model to a recording."""
