"""Faults in signals, images and forces; safety_monitor checks the arm's limits."""
