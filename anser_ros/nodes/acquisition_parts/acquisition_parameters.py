"""Lists the parameters of the acquisition."""

from dataclasses import dataclass

from anser_ros.nodes.runtime.parameters import parameter
from anser_ros.wire.port import DEFAULT_BAUD, SILENCE_S
from anser_ros.wire.protocols import PROTOCOLS


@dataclass(frozen=True)
class AcquisitionParameters:
    """Holds the parameters of the acquisition."""

    device: str = parameter(
        '/dev/ttyACM0', "the control unit's port, or auto: listen on all ports for its hello"
    )
    protocol: str = parameter('anser', 'protocol of the control unit', choices=tuple(PROTOCOLS))
    baud: int = parameter(
        DEFAULT_BAUD, 'baud rate of the line; ignored over USB', minimum=9600, maximum=50_000_000
    )
    setup_file: str = parameter('demo_setup.yaml', 'setup document: a path, or a file of config/')
    channels_file: str = parameter(
        'demo_channels.yaml', 'channel calibration: a path, or a file of config/'
    )
    window_s: float = parameter(
        0.02, 'length of a demodulation window, s', minimum=0.005, maximum=0.05, live=True
    )
    rate_hz: float = parameter(
        0.0,
        'windows a second, may overlap; 0 for the rate of the setup document',
        minimum=0.0,
        maximum=1000.0,
        live=True,
    )
    mains_hz: float = parameter(
        0.0,
        'mains whose harmonics are fitted too; 0 for none',
        minimum=0.0,
        maximum=400.0,
        live=True,
    )
    set_frequencies: bool = parameter(
        True, 'whether the control unit is told to drive the tones of the setup document'
    )
    silence_s: float = parameter(
        SILENCE_S,
        'time without a byte after which it reports a fault, s',
        minimum=0.1,
        maximum=60.0,
    )
