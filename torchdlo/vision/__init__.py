"""Cameras and pictures: what scenes look like, masks of ropes, and a differentiable rasteriser."""
