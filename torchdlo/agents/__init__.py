"""Learning agents and trajectory optimisation."""
