"""Finds poses of single coils and rigid tools in frames of fluxes, with state and covariance."""
