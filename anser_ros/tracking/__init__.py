"""Poses of single coils and rigid tools from frames of fluxes, with a state and a covariance."""
