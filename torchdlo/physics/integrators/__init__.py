"""One substep of the rods, and how large it may be."""
