"""Robots: kinematics, inverse kinematics, attachment of ropes to tools."""
