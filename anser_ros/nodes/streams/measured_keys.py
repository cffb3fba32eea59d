"""Names what acquisition measures and states in the setup document while it runs."""

FLUX_NOISE = 'flux_noise_t'
"""Key of the setup document: what the fluxes' components scatter by, T."""
STAMP_SIGMA = 'stamp_sigma_s'
"""Key of the setup document: what the stamps are uncertain by, s."""
FLUX_RATE = 'flux_rate_hz'
"""Key of the setup document: the fluxes' rate, which is the stream's own once there is one, Hz."""


def without_measured(text: str) -> str:
    """Return a setup document's text without the values that acquisition measures.

    What is left never changes while a sender runs: board, coils and sensors.
    """
    keys = tuple(f'{key}:' for key in (FLUX_NOISE, STAMP_SIGMA, FLUX_RATE))
    return '\n'.join(line for line in text.split('\n') if not line.startswith(keys))
