"""Lists the parameters of the node that serves the field model."""

from dataclasses import dataclass

from anser_ros.nodes.runtime.parameters import parameter
from anser_ros.nodes.runtime.stated_parameters import stated
from anser_ros.refit.change import MOST_RATE_HZ
from anser_ros.sessions.starting_model import NOMINAL


@dataclass(frozen=True)
class FieldModelParameters:
    """Holds the parameters of the field model's server."""

    model_file: str = parameter(
        NOMINAL,
        "model to start from: a file, or nominal for that of the setup's own geometry",
        live=True,
    )
    allow_uncalibrated: bool = parameter(
        False, 'whether trackers may give poses by the nominal model', live=True
    )
    refit: bool = parameter(
        True, 'whether the model follows the reference sensors once a baseline is set', live=True
    )
    baseline_file: str = parameter(
        '', 'distortion-free recording of the same board; empty: wait for set_baseline'
    )
    baseline_at_start: bool = parameter(
        False, 'whether the first readings are the distortion-free ones'
    )
    baseline_s: float = parameter(
        1.0, 'time that a baseline is averaged over, s', minimum=0.05, maximum=60.0
    )
    keep_state: bool = parameter(
        True, 'whether baseline and tables are kept on disk for a node that is started again'
    )
    refit_rate_hz: float = parameter(
        MOST_RATE_HZ, 'most refits a second, by the stamps', minimum=2.0, maximum=1000.0, live=True
    )
    witnesses: bool = parameter(
        False, 'whether contradictions among the coils of rigid tools tell of metal, too'
    )
    save_file: str = parameter(
        'field_model.yaml', 'where the service save writes the model', live=True
    )
    flux_noise_t: float = stated('flux_noise_t')
    reference_position_m: float = stated('reference_position_m')
    reference_axis_rad: float = stated('reference_axis_rad')
    reference_gain: float = stated('reference_gain')
    emitter_drift: float = stated('emitter_drift')
    min_references: int = stated('min_references')
    average_frames: int = stated('average_frames')
    persistence: float = stated('persistence')
    hold_frames: int = stated('hold_frames')
    references_age_s: float = stated('references_age_s')
    error_modes: int = stated('error_modes')
    seed: int = stated('seed')
