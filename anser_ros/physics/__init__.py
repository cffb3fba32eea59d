"""Holds the physics of current paths, dipoles and pick-up coils; it imports no other package."""
