"""Reinforcement learning: trainers, their loop, and policies made out of trajectories."""
