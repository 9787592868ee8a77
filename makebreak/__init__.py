"""Adaptive control for robots that make and break contact, on Drake."""

__version__ = "0.1.0"
