"""Material points, and their coupling to ropes and rigid bodies."""
