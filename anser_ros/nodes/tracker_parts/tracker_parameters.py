"""Lists the parameters of the tracker, and makes the core's settings of them."""

from dataclasses import dataclass

from anser_ros.errors import AnserError, ParameterError
from anser_ros.nodes.runtime.parameters import parameter
from anser_ros.nodes.runtime.shared_names import STALE_AFTER_S
from anser_ros.nodes.runtime.stated_parameters import stated
from anser_ros.physics.volume import TrackedVolume
from anser_ros.tracking.estimate import NO_GATE, TrackerSettings
from anser_ros.wire.setup_tips import TipSpec, read_tips
from anser_ros.wire.text_files import read_text


@dataclass(frozen=True)
class TrackerParameters:
    """Holds the parameters of the tracker."""

    model_file: str = parameter(
        '',
        'model whose effects are corrected, and whose field is used until field_model publishes '
        'one; empty or nominal for none',
        live=True,
    )
    tips_file: str = parameter(
        '', "tips.yaml of pivot, or a setup document, whose tips replace the setup's own"
    )
    frame_prefix: str = parameter(
        '',
        "prefix of the frames of poses and of /tf, the board's too, if there are several boards",
    )
    allow_uncalibrated: bool = parameter(
        False, 'whether poses are given by the nominal model though field_model withholds them'
    )
    flux_noise_t: float = stated('flux_noise_t')
    stamp_sigma_s: float = stated('stamp_sigma_s')
    references_age_s: float = stated('references_age_s')
    tool_coil_position_m: float = stated('tool_coil_position_m')
    tool_coil_axis_rad: float = stated('tool_coil_axis_rad')
    tool_coil_gain: float = stated('tool_coil_gain')
    max_speed_m_s: float = stated('max_speed_m_s')
    max_acceleration_m_s2: float = stated('max_acceleration_m_s2')
    adaptive: bool = parameter(
        TrackerSettings.adaptive,
        'whether the noise follows the residuals of good poses',
        live=True,
    )
    gate: float = parameter(
        TrackerSettings.gate,
        'largest residual of a pose, in units of the expected one',
        minimum=1.0,
        maximum=NO_GATE,
        live=True,
    )
    max_sigma_m: float = parameter(
        TrackerSettings.max_sigma_m,
        'largest uncertainty of a pose, m',
        minimum=1e-5,
        maximum=1.0,
        live=True,
    )
    volume_low_m: tuple[float, ...] = parameter(
        (), "lower corner of the tracked volume, m; empty: the setup's volume"
    )
    volume_high_m: tuple[float, ...] = parameter(
        (), "upper corner of the tracked volume, m; empty: the setup's volume"
    )
    grid_spacing_m: float = parameter(
        TrackerSettings.grid_spacing_m,
        'spacing of the cold start at 0.1 m height, m',
        minimum=0.005,
        maximum=0.2,
    )
    warm_age_s: float = parameter(
        TrackerSettings.warm_age_s,
        'largest age of a good pose that a solve starts from, s',
        minimum=0.01,
        maximum=60.0,
        live=True,
    )
    stale_after_s: float = parameter(
        STALE_AFTER_S,
        'time without fluxes after which a sensor is stale, s',
        minimum=0.02,
        live=True,
    )
    model_wait_s: float = parameter(
        0.1,
        'longest time that a frame waits for the model of its instant while field_model refits, s',
        minimum=0.0,
        maximum=10.0,
        live=True,
    )
    publish_tf: bool = parameter(True, 'whether /tf is published where tf2_msgs is installed')


def settings_of(table: TrackerParameters) -> TrackerSettings:
    """Return settings of the core.

    Raises `ParameterError` when a corner of the volume is not three numbers, or only one of the
    two is given, and `TrackingError` when the corners make no box.
    """
    low, high = table.volume_low_m, table.volume_high_m
    volume = None
    if low or high:
        for name in ('volume_low_m', 'volume_high_m'):
            if len(getattr(table, name)) != 3:
                raise ParameterError(f'parameter {name}: three numbers needed')
        volume = TrackedVolume((low[0], low[1], low[2]), (high[0], high[1], high[2]))
    names = ('adaptive', 'grid_spacing_m', 'gate', 'max_sigma_m', 'warm_age_s')
    return TrackerSettings(volume=volume, **{name: getattr(table, name) for name in names})


def tips_of_file(path: str) -> dict[str, TipSpec]:
    """Return tips of a file by body; none where no file is named.

    Raises `ParameterError` when it can't be read, and `SetupError` when it has no tips.
    """
    try:
        return read_tips(read_text(path)) if path else {}
    except AnserError as error:
        raise type(error)(f'parameter tips_file: {error}') from error
