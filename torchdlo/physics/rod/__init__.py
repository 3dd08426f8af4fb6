"""Ropes as tensors: topology, kinematics, assembly from what a person knows, prescribed motion."""
