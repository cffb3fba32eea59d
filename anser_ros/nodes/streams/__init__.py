"""Holds what several nodes receive or send: clouds, one believed publisher, the newest frame."""
