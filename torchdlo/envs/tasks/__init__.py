"""The ten tasks."""
