"""Edge lengths as constraints, solved directly."""
