"""Holds what goes over wires and into files: frames, port, bags, setup and model documents."""
