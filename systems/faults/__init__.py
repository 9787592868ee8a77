"""Faults in signals, pictures and forces, and safety_monitor, which watches limits."""
