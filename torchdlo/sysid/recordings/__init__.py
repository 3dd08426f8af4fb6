"""Measured recordings: format, checks, data quality, metrics, trivial predictors."""
