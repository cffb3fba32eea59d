"""Only the noise has grown."""

from anser_ros.effects.seen import SeenEffect


class ExcessNoise(SeenEffect):
    """Is found from the residuals' spread once they show no structure (`anser_ros.diagnosis`)."""

    name = 'excess_noise'
    summary = 'the noise is larger than it should be, and nothing else'
    units = {'factor': '1', 'channels': '1'}
    plausible = {'factor': (1.0, 1000.0)}


EXCESS_NOISE = ExcessNoise()
EFFECTS = (EXCESS_NOISE,)
