"""Tasks and environments for reinforcement learning."""
