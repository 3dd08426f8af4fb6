"""Arms, rope materials and rigid objects of tasks."""
