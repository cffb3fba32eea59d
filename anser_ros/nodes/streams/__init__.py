"""Holds what several nodes receive or send: clouds, a single publisher, the newest frame."""
