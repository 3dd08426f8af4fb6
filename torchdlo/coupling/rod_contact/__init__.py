"""Contact of ropes with each other and with themselves."""
