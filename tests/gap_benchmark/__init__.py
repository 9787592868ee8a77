"""Recordings with hidden effects, made by other simulators than the one that fits.

cases.py draws the cases; nothing in here is imported by the project, and nothing in
here imports the catalogue of effects: what an effect does is written anew.
"""
