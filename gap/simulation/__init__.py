"""Scenes simulated from measured states, and how far they end from the measured."""
