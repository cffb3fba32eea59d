"""From samples to fluxes: windows, least-squares demodulation, conversion, and device time."""
