"""Searches for what a model lacks: residuals, effects, confirmation, and what stays."""
