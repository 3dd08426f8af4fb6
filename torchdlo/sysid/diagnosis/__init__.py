"""Diagnosis: which effect a recording shows and the model lacks."""
