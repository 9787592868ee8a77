"""Adaptive control of a point in the plane: planar_world, planar_impedance."""
