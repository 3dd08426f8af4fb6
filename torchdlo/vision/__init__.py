"""Cameras and pictures: what scenes look like, below everything that learns from it."""
