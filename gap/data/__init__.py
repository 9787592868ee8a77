"""Recordings: what is on disk, what is said of it, and what is made of it."""
