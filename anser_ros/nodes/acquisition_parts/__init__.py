"""Holds the parts of acquisition: blocks of samples to fluxes, their stamps, noise and faults."""
