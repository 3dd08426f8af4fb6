"""Calibration from films: readings of pictures, starts, cameras and clocks as nuisances."""
