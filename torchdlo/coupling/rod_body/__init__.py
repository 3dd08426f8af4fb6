"""Contact of ropes with rigid bodies and between finger pads."""
