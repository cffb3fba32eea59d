"""Makes fluxes of samples: windows, least-squares demodulation, conversion, and device time."""
