"""From samples to phasors: windows, least-squares demodulation, fluxes and device time."""
