"""Defines the settings of tracking, and the pose estimates that it gives, of tips too."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from anser_ros.arrays import Array
from anser_ros.errors import TrackingError
from anser_ros.kernel_cache import inlined
from anser_ros.physics.volume import TrackedVolume
from anser_ros.settings import Accuracy, ToolSettings
from anser_ros.tracking.solve import ROLL_VARIANCE

USUAL_GATE = 4.0
"""Largest residual of a pose in units of the expected one, unless a setting says another. Smaller,
and poses are lost to the model's own small errors; larger, and distorted poses pass."""

NO_GATE = 1e6
"""A gate of so much or more is no gate: no pose is refused for its residual."""

DEFAULT_VOLUME = TrackedVolume()

MEMORY_FRAMES = 100.0
"""Good frames over which the noise is averaged, 2 s at 50 Hz: it is then known to a tenth with one
coil of eight emitters. Fewer follow the noise of single frames; more are late when it changes."""
PRIOR_FRAMES = 8.0
"""Frames for which the stated noise counts at the start, so that the first one does not decide."""
HIDDEN = 20.0 / 11.0
"""Power of a distortion that goes into the pose over the power that stays in the residual: of a
coil with eight emitters the five dimensions of the pose get four times what each of the eleven
others gets, as a smooth distortion looks more like a pose than like anything else."""
SLIGHT = 0.1
"""Residual power that lasts from frame to frame, in units of the expected power, up to which it is
no misfit: of noise alone, a coil with eight emitters has 0 +- 0.02."""
SUDDEN_FRAMES, SUDDEN = 8.0, 0.5
"""Good frames over which such power is averaged besides, and beyond which it is misfit: of noise
alone it has 0 +- 0.08. The long mean alone lets a bend of 0.8 mm pass for noise for a second."""


SYSTEMATIC = 25.0
"""Factor on the variances of a pose whose misfit is more than noise where no gate refuses it, of
one that only a gate wider than the usual one lets pass, and of one without a check. A wrong gain
moves a pose further than noise of the same residual: by up to 8 of its sigmas with a factor of 4
(2 to 20 %, on one coil, simulated). Smaller, and 3 sigma do not hold there; larger, and poses that
are asked for in spite of their misfit are called more uncertain than they are."""


@inlined
def sigma_factor(has_gate, scale):  # type: ignore[no-untyped-def]
    """Return the factor on ``max_sigma_m``: larger without a gate, by the misfit."""
    return 1.0 if has_gate else math.sqrt(max(1.0, scale))


@dataclass(frozen=True)
class TrackerSettings:
    """States what the tracker may assume."""

    # Standard deviation of each phasor component, T, before anything has been tracked
    flux_noise_t: float = Accuracy.flux_noise_t
    # Whether each sensor's noise scale follows the residuals of its recent good frames
    adaptive: bool = True
    # Where tools may be; a pose outside is refused. None: the tracker's box over an Anser board.
    volume: TrackedVolume | None = None
    grid_spacing_m: float = 0.035  # Spacing of the cold start's grid at 0.1 m height
    # A pose whose residual is more than so many times the expected one is refused; from `NO_GATE`
    # on none is (to measure what that costs, never for use), see `judges`
    gate: float = USUAL_GATE
    # A second pose that is more likely than one to so many makes the first ambiguous
    odds: float = 1000.0
    max_sigma_m: float = 0.01  # Poses less certain than this are refused as ambiguous, m
    min_signal: float = 4.0  # Fluxes whose rms is below so many noise sigmas are no signal
    warm_age_s: float = 1.0  # How old a good pose may be to start from
    # Variance given to the roll about a single coil's axis, rad^2
    roll_variance: float = ROLL_VARIANCE
    # Whether an emitter's drift takes the course that the model's effects recorded: only on the
    # session that they were found on, and with a model that doesn't follow the references
    recorded_drift: bool = False
    stamp_sigma_s: float = Accuracy.stamp_sigma_s  # Error of a flux stamp, s
    # How well tools are known, and how fast they may be
    tools: ToolSettings = field(default_factory=ToolSettings)

    def __post_init__(self) -> None:
        for name in (
            'flux_noise_t', 'grid_spacing_m', 'gate', 'max_sigma_m', 'warm_age_s', 'roll_variance',
        ):  # fmt: skip
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0) and not (name == 'gate' and value > 0):
                raise TrackingError(f'setting {name} must be positive and finite, got {value}')
        if not 0.0 <= self.stamp_sigma_s < math.inf:
            raise TrackingError(
                f'setting stamp_sigma_s must be finite and not negative, got {self.stamp_sigma_s}'
            )
        if not self.odds >= 1 or not self.min_signal >= 0:
            raise TrackingError('settings: odds must be at least 1, min_signal at least 0')

    @property
    def has_gate(self) -> bool:
        """Return whether poses are refused for their residuals."""
        return self.gate < NO_GATE

    @property
    def judges(self) -> bool:
        """Return whether poses are compared with their body and their past.

        A wide gate of residuals does not end that, only one that is infinite, or that of a tracker
        which takes its noise as stated: these give whatever is found.
        """
        return self.has_gate or (self.adaptive and math.isfinite(self.gate))

    @property
    def box(self) -> TrackedVolume:
        return self.volume or DEFAULT_VOLUME

    def margin(self, ratio: float) -> float:
        """Return the chi-square by which a rival must be worse, ``ratio`` being the residual power
        per freedom.

        A misfit counts as noise would; without a gate the best of several badly fitting poses is
        taken.
        """
        if not self.has_gate and ratio > USUAL_GATE**2:
            return -math.inf
        return 2.0 * math.log(self.odds) * max(1.0, ratio)


@dataclass  # Not frozen: it would take three times as long to make, ten times a frame
class PoseEstimate:
    """Holds one sensor's or body's pose in one frame, or why there is none."""

    name: str  # Of the sensor or body
    stamp_ns: int  # The flux message's stamp
    # One of `anser_ros.pose_states.STATES`; the pose may only be used when it is ``ok``
    state: str
    position: Array  # (3,), m, frame fg; NaN where nothing was solved
    axis: Array  # (3,), sensitive axis of a sensor, +z of a body; unit vector, frame fg
    # (3, 3), body axes in fg (columns); None for a single coil, whose roll is not observable
    rotation: Array | None
    # (6, 6), position (m^2) and rotation vector (rad^2), both in fg; the model's uncertainty
    # included
    covariance: Array
    residual_t: float  # Root mean square of measured minus modelled flux components, T
    chi2: float  # Residual power per degree of freedom in units of the expected one
    model_id: str  # Which field model made it
    reason: str = ''  # Why the state is not ``ok``, in words with figures
    checks: int = 0  # Readings beyond the pose's unknowns, which could contradict it

    @property
    def sigma_position_m(self) -> float:
        """Return the square root of the trace of the position's covariance."""
        matrix = self.covariance
        return math.sqrt(matrix[0, 0] + matrix[1, 1] + matrix[2, 2])


def no_pose(name: str, stamp_ns: int, state: str, model_id: str, reason: str) -> PoseEstimate:
    """Return an estimate without a pose: all figures NaN."""
    nothing = np.full(3, np.nan)
    return PoseEstimate(
        name, stamp_ns, state, nothing, nothing, None, np.full((6, 6), np.nan), math.nan,
        math.nan, model_id, reason,
    )  # fmt: skip


FRESH_NOISE = PRIOR_FRAMES, PRIOR_FRAMES, 0.0, 0.0
"""State (4,) of a noise scale before the first frame: weight, power, and power that lasts, over
many frames in units of the weight, and over few.

It estimates residual power over its expectation as frames pass: 1 when the noise is as stated. It
is an exponential mean over about `MEMORY_FRAMES` good frames, that starts as if `PRIOR_FRAMES` had
been as expected. Noise is new in each frame; what stays in the residuals is misfit."""


@inlined
def scale_of_frame(noise, ratio, limits, share, model_share, follows):  # type: ignore[no-untyped-def]
    """Return one frame's variance scale: the running one, or more if its residual asks for it.

    ``ratio`` is its residual power over the expected one, and ``limits`` what noise seldom
    exceeds, of which more comes from a bent field, and what is `SYSTEMATIC`. ``share`` are
    degrees of freedom for each dimension of the pose: what stays in the former of a bent field
    shows, as a power, what goes into the latter. ``model_share`` of the expected residual is the
    model's own error. It bends the field as metal does, and as much of it goes into the pose,
    however many readings there are. If the model states its error by modes, which it ``follows``,
    no small residual takes that error off the pose, and no lasting misfit is taken for noise.
    """
    hidden, lasting = HIDDEN * share, noise[2] / noise[0]
    misfit = max(lasting - model_share - SLIGHT, 0.0)  # beyond the model's own error
    least = max(noise[1] / noise[0] - misfit, SLIGHT)
    scale = max(least, 1.0) if follows else least
    scale *= 1.0 + model_share * max(hidden - 1.0, 0.0)
    expected = min(least, 1.0) if follows else least
    sudden = noise[3] - model_share - SUDDEN
    scale += hidden * max(misfit, sudden, ratio - limits[0] * expected)
    return scale if ratio <= limits[1] else SYSTEMATIC * scale


@inlined
def add_frame(noise, ratio, lasting):  # type: ignore[no-untyped-def]
    """Take a good frame into the state (4,) of a noise scale, in place.

    ``ratio`` is its residual power over the expected one, ``lasting`` the product of its whitened
    residuals and the last frame's per freedom.
    """
    keep, most = 1.0 - 1.0 / MEMORY_FRAMES, 4.0 * noise[1] / noise[0]
    noise[0] = keep * noise[0] + 1.0
    noise[1] = keep * noise[1] + min(ratio, most)
    noise[2] = keep * noise[2] + min(lasting, most)
    noise[3] += (min(lasting, most) - noise[3]) / SUDDEN_FRAMES


@dataclass(frozen=True)
class Tip:
    """States where a tip is on its body."""

    name: str  # Of the tip, in topics and in ``/diagnostics``
    position: Array  # (3,), m, body's frame
    covariance: Array  # (3, 3), m^2, body's frame: what its calibration leaves unknown

    def of_body(self, body: PoseEstimate) -> PoseEstimate:
        """Return the tip's pose with its body's state; none where the body has none.

        The tip moves with the body's position and by a turn times the arm. To first order, with
        the arm ``a`` in fg, ``d_tip = d_body - [a]x d_turn + R d_arm``, and turns are the body's.
        """
        if body.rotation is None:
            return no_pose(self.name, body.stamp_ns, body.state, body.model_id, body.reason)
        arm = body.rotation @ self.position
        x, y, z = arm
        carry = np.eye(6)
        carry[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        covariance = carry @ body.covariance @ carry.T
        covariance[:3, :3] += body.rotation @ self.covariance @ body.rotation.T
        return replace(body, name=self.name, position=body.position + arm, covariance=covariance)
