"""Redoes the article's experiments: the compared methods, the errors of each, and their bound."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from anser_ros.apps.lab.experiments.recordings import (
    HEAD_DISTANCES_CM,
    MATERIALS,
    STATISTICS,
    Recordings,
    checkerboard,
)
from anser_ros.apps.lab.measured import anser_board
from anser_ros.apps.lab.measured.recipe import shared_folder
from anser_ros.arrays import Array, as_complex, as_real
from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.error_map import learn_error_map
from anser_ros.calibration.layout_fit import emitter_gains
from anser_ros.calibration.layouts import Layout, place
from anser_ros.calibration.least_squares import TriangularFactor
from anser_ros.calibration.moments import Progress
from anser_ros.calibration.readings import (
    DipoleSites,
    basis_rows,
    flux_slopes,
    usable_readings,
    with_pose,
)
from anser_ros.calibration.result import Calibration
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.physics.constants import MU_0
from anser_ros.physics.rotations import axis_angles, tangents
from anser_ros.sessions.calibration import calibrate_sessions, generator_of
from anser_ros.sessions.session import Session
from anser_ros.sessions.starting_model import model_for
from anser_ros.sessions.tracked_session import error_statistics, track_session
from anser_ros.simulation.recording import STATIC_NOISE_T
from anser_ros.wire.text_files import NOMINAL


def position_bound(measurements: Measurements, model: FieldModel, noise_t: float) -> Array:
    """Return the least position error of unbiased estimates of each sensor, rms, (S,), m.

    The Fisher information of position and axis is ``J^T J / sigma^2`` (Kay, Estimation Theory,
    1993, section 3.7); the axis, a unit vector, counts in its tangent plane.

    ``measurements``: the poses at which it is wanted. ``noise_t``: of a phasor component, T.
    """
    posed, sites = with_pose(measurements), DipoleSites(model.positions, model.directions)
    _, by_place, by_axis = flux_slopes(posed, sites, model.moments)
    across = tangents(posed.placed()[1].reshape(-1, 3)).reshape(*by_axis.shape[:2], 2, 3)
    slope = as_real(np.concatenate([by_place, across @ by_axis], axis=2)) / noise_t
    covariance = np.linalg.inv(slope @ slope.transpose(0, 1, 3, 2))
    variance = np.trace(covariance[:, :, :3, :3], axis1=2, axis2=3)
    return np.asarray(np.sqrt(variance.mean(axis=0)))


ARTICLE_COUNT = 12
"""Dipoles along a side of the article's layer, as it states."""
OUTLINE = 1.0
"""Size of the article's layer as a multiple of the coils' outline."""


def centres_extension(session: Session) -> float:
    """Return the size of a layer up to the outermost coil centres, relative to the outline."""
    generator = generator_of(session.setup)
    centres = generator.centres[:, :2]
    reach = np.abs(centres - generator.middle[:2]).max(axis=0)
    return float((reach / generator.half_extent).max())


def drawn_model(session: Session) -> FieldModel:
    """Return the drawing's Biot-Savart model with a real gain for each emitter.

    The gains are fitted to the session, which must be undistorted.
    """
    nominal = model_for(NOMINAL, session)
    tools = [with_pose(tool) for tool in session.tools]
    gains = emitter_gains(nominal, tools).real
    # The drawing's own tolerances are what the gains and the data now replace.
    model = replace(nominal, moments=nominal.moments * gains, modes=None)
    errors, _ = in_phase_errors(model, tools)
    return expecting(model, float(np.sqrt(np.mean(errors**2))))


def expecting(model: FieldModel, flux_error_t: float) -> FieldModel:
    """Return the model with at least this error of its own, so that solutions are not refused."""
    return replace(model, flux_error_t=max(flux_error_t, model.flux_error_t))


def in_phase_errors(model: FieldModel, tools: Sequence[Measurements]) -> tuple[Array, Array]:
    """Return in-phase residuals at the measured poses, and what was measured there, (P, K), T."""
    pairs = [
        ((flux - model.flux(points, axes, lengths)).real, flux.real)
        for points, axes, lengths, flux in usable_readings(tools)
    ]
    errors, measured = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return errors, measured


def article_model(session: Session, extension: float = OUTLINE) -> FieldModel:
    """Return the article's model: 12 x 12 fixed z-dipoles by least squares (its equation 6)."""
    dipoles = place(Layout('layer', ARTICLE_COUNT, extension, 0.0), generator_of(session.setup))
    factor = TriangularFactor(len(dipoles), 2 * len(session.setup.emitter_names))
    for tool in session.tools:
        posed = with_pose(tool)
        used = posed.usable.ravel()
        right = as_real(posed.flux).reshape(used.size, -1)
        factor.add(basis_rows(posed, dipoles)[used], right[used])
    moments = as_complex(factor.spectrum().solve(0.0)).real.astype(complex)
    return FieldModel(
        dipoles.positions, dipoles.directions, moments,
        session.setup.emitter_names, session.setup.frequencies_hz,
    )  # fmt: skip


@dataclass(frozen=True)
class SensorErrors:
    """Holds one sensor's errors frame by frame, with NaN where it was not tracked."""

    # (F, 3), tracked and optical position, m, frame fg
    tracked: Array
    true: Array
    # (F,), position error, m, and orientation error, rad
    distance: Array
    angle: Array

    def corrected(self, tracked: Array) -> 'SensorErrors':
        """Return the errors with other tracked positions."""
        distance = np.where(
            np.isfinite(self.distance), np.linalg.norm(tracked - self.true, axis=1), np.nan
        )
        return SensorErrors(tracked, self.true, distance, self.angle)

    def millimetres(self) -> dict[str, float]:
        """Return RMSE, ME, PRC50 and PRC95 of the position (article, equation 7), mm."""
        return statistics(1e3 * self.distance)

    def document(self) -> dict[str, Any]:
        """Return these, those of the orientation, and the share of frames with a pose."""
        return {
            'position_mm': self.millimetres(),
            'orientation_deg': statistics(np.degrees(self.angle)),
            'tracked_fraction': float(np.isfinite(self.distance).mean()),
        }


def statistics(errors: Array) -> dict[str, float]:
    """Return the article's four figures of errors, or NaN without any finite error."""
    found = error_statistics('', '', errors[np.isfinite(errors)]).values()
    values = (np.nan if value is None else value for value in found)
    return dict(zip(STATISTICS, values, strict=True))


def track(session: Session, model: FieldModel, in_phase: bool = False) -> dict[str, SensorErrors]:
    """Track a session and return the errors by the last part of a sensor's name, in capitals.

    As in the article every solution counts, even if a tracker would withhold it for its residual.
    """
    evaluation = track_session(session, model, in_phase=in_phase)
    out = {}
    for tool in session.tools:
        centres, axes = tool.placed()
        for column, name in enumerate(tool.sensors.name):
            series = evaluation.sensors[name]
            tracked = np.array([estimate.position for estimate in series.estimates])
            found = np.array([estimate.axis for estimate in series.estimates])
            distance = np.linalg.norm(tracked - centres[:, column], axis=1)
            angle = axis_angles(found, axes[:, column])
            token = name.rsplit('/', 1)[-1].upper()
            out[token] = SensorErrors(tracked, centres[:, column], distance, angle)
    return out


Errors = dict[str, SensorErrors]


@dataclass
class Results:
    """Holds the results of all experiments."""

    origin: str  # who simulated the recordings
    # errors by experiment, method and sensor
    tracking: dict[str, dict[str, Errors]] = field(default_factory=dict)
    # the article's field metrics by material, method and set
    fields: dict[str, dict[str, dict[str, dict[str, float]]]] = field(default_factory=dict)
    # cramer-Rao bound of each sensor by experiment, m
    bounds: dict[str, dict[str, float]] = field(default_factory=dict)
    # figures of our model's choice by the recording that it was trained on
    models: dict[str, str] = field(default_factory=dict)
    # the error map of Table V in words, by method and sensor
    corrections: dict[str, dict[str, str]] = field(default_factory=dict)
    # `board_runs` of a real tracker's positions; the only measured data here
    board_runs: list[dict[str, Any]] = field(default_factory=list)

    def document(self) -> dict[str, Any]:
        """Return the figures as plain data."""
        return {
            'schema': 'anser_paper/1',
            'origin': self.origin,
            'tracking': {
                experiment: {
                    method: {sensor: found.document() for sensor, found in errors.items()}
                    for method, errors in methods.items()
                }
                for experiment, methods in self.tracking.items()
            },
            'fields': self.fields,
            'bounds_m': self.bounds,
            'models': self.models,
            'corrections': self.corrections,
            'measured_board': self.board_runs,
        }


class Study:
    """Runs the experiments one by one, and keeps what several of them need."""

    def __init__(self, recordings: Recordings, progress: Progress | None = None) -> None:
        self.recordings, self.progress = recordings, progress
        self.results = Results(recordings.origin)

    @cached_property
    def factory(self) -> Session:
        """Return the recording of tool A without metal."""
        return self.recordings.load('factory_tool_a')

    @cached_property
    def factory_calibration(self) -> Calibration:
        """Return this package's model of the board without metal."""
        return self._ours('factory_tool_a', self.factory)

    @cached_property
    def drawing(self) -> FieldModel:
        """Return the drawing's Biot-Savart model with gains from the recording without metal."""
        return drawn_model(self.factory)

    def run(self) -> Results:
        """Run all experiments and return their results."""
        steps: tuple[tuple[str, Callable[[], None]], ...] = (
            ('Table II', self.new_model),
            ('Table III', self.shields),
            ('Fig. 7', self.head),
            ('Table IV', self.shields_and_head),
            ('Table V', self.compensation),
            ('error maps', self.error_maps),
        )
        for count, (name, step) in enumerate(steps):
            if self.progress is not None:
                self.progress(name, count / len(steps))
            step()
        return self.results

    def _ours(self, name: str, session: Session) -> Calibration:
        calibration = calibrate_sessions([session], Options())
        self.results.models[name] = (
            f'{calibration.layout.describe()}, damping {calibration.damping:g}, '
            f'{calibration.n_measurements} readings per emitter, held out '
            f'{1e12 * calibration.held_out.score_t:.0f} pT with the pose marginalised'
        )
        return calibration

    def _bent(self, model: FieldModel) -> FieldModel:
        """Return a model with the error of a distorted field that it does not know."""
        return expecting(model, self.drawing.flux_error_t)

    def _bound(self, experiment: str, session: Session, model: FieldModel) -> None:
        tool = session.tools[0]
        limits = position_bound(tool, model, STATIC_NOISE_T)
        self.results.bounds[experiment] = {
            name.rsplit('/', 1)[-1].upper(): float(limit)
            for name, limit in zip(tool.sensors.name, limits, strict=True)
        }

    def _compare(
        self, experiment: str, test: Session, ours: FieldModel, **others: FieldModel
    ) -> dict[str, Errors]:
        """Track a recording by models of other methods, in phase as theirs are, and by ours."""
        errors = {name: track(test, model, in_phase=True) for name, model in others.items()}
        errors['ours'] = track(test, ours)
        self.results.tracking[experiment] = errors
        return errors

    def new_model(self) -> None:
        """Run Table II and Fig. 5: the model without metal, tested with tool B."""
        test = self.recordings.load('midplane_tool_b')
        ours = self.factory_calibration.model
        others = {
            'drawing': self.drawing,
            'article': article_model(self.factory),
            'article, layer over the centres': article_model(
                self.factory, centres_extension(self.factory)
            ),
        }
        self._compare('table_2', test, ours, **others)
        self._bound('table_2', test, ours)

    def shields(self) -> None:
        """Run Table III and Fig. 6: half of the points over a plate predict the other half."""
        for material in MATERIALS:
            training, test = checkerboard(self.recordings.shield(material))
            article = article_model(training)
            ours = self._ours(f'{material}, half', training).model
            sets = {'training': training, 'test': test}
            self.results.fields[material] = {
                method: {name: field_errors(part, model) for name, part in sets.items()}
                for method, model in (('article', article), ('ours', ours))
            }
            self._compare(f'table_3 {material}', test, ours, article=article)
            self._bound(f'table_3 {material}', test, ours)

    def head(self) -> None:
        """Run Figs. 7 and 8: the X-ray head comes closer, without compensation."""
        # What bends the field is not in this model; it only knows that it may be wrong.
        ours = self._bent(self.factory_calibration.model)
        for distance in HEAD_DISTANCES_CM:
            test = self.recordings.load(f'c_arm_{distance:02d}cm_tool_b')
            self._compare(f'fig_7 {distance} cm', test, ours, drawing=self.drawing)

    @cached_property
    def shield_models(self) -> dict[str, tuple[FieldModel, FieldModel]]:
        """Return the article's model and ours of each material, from all points over the plate."""
        out = {}
        for material in MATERIALS:
            session = self.recordings.shield(material)
            out[material] = (article_model(session), self._ours(f'{material}, all', session).model)
        return out

    def shields_and_head(self) -> None:
        """Run Table IV and Fig. 9: models of the plate alone are tested with plate and head."""
        for material in MATERIALS:
            test = self.recordings.shield(material, head=True)
            article, ours = (self._bent(model) for model in self.shield_models[material])
            self._compare(f'table_4 {material}', test, ours, article=article)
        nearest = f'fig_7 {HEAD_DISTANCES_CM[-1]} cm'
        self.results.tracking['table_4 unshielded'] = self.results.tracking[nearest]

    def compensation(self) -> None:
        """Run Table V and Fig. 10: two planes over the head predict the one between them."""
        session = self.recordings.load('collimator_tool_a')
        training = outer_planes(session)
        article, ours = article_model(training), self._ours('collimator', training).model
        bottom = self.recordings.load('collimator_bottom_tool_b')
        test = self.recordings.load('collimator_midplane_tool_b')
        clean = self._bent(self.factory_calibration.model)
        self._compare('table_5 uncompensated', test, clean, drawing=self.drawing)
        compensated = self._compare('table_5 compensated', test, ours, article=article)
        known = {'article': track(bottom, article, in_phase=True), 'ours': track(bottom, ours)}
        self.results.tracking['table_5 compensated and corrected'] = {
            method: self._corrected(method, known[method], errors)
            for method, errors in compensated.items()
        }
        self._bound('table_5 compensated', test, ours)

    def error_maps(self) -> None:
        """Run the error map of a tracker that gives positions only."""
        self.results.board_runs = board_runs(anser_board.RECIPE.data(shared_folder()))

    def _corrected(self, method: str, known: Errors, errors: Errors) -> Errors:
        """Return errors after an error map learnt in the bottom plane, if it helps there."""
        out, words = {}, {}
        for sensor, found in errors.items():
            error_map = learn_error_map(known[sensor].tracked, known[sensor].true)
            words[sensor] = (
                f'{error_map.shape.describe()} (bottom plane, held out: '
                f'{1e3 * error_map.before.judged:.3f} mm without a map, '
                f'{1e3 * error_map.after.judged:.3f} mm with)'
            )
            out[sensor] = found.corrected(error_map.apply(found.tracked))
        self.results.corrections[method] = words
        return out


def outer_planes(session: Session) -> Session:
    """Return the recording of a stack of coils without those of its middle plane."""
    tool = session.tools[0]
    heights = tool.sensors.position[:, 2]
    outer = np.abs(heights - np.median(heights)) > 0.25 * np.ptp(heights)
    return replace(session, tools=(tool.sensors_only(np.flatnonzero(outer)),), reference=None)


def field_errors(session: Session, model: FieldModel) -> dict[str, float]:
    """Return the in-phase errors of the field over all sensors, emitters and measured poses.

    They are those of the article's equation (8): MAE and RMSE in mA/m, N-MAE and N-RMSE in percent
    of the range of the measured values.
    """
    error, measured = in_phase_errors(model, session.tools[:1])
    span = float(np.ptp(measured))
    mean, square = float(np.abs(error).mean()), float(np.sqrt((error**2).mean()))
    return {
        'MAE': 1e3 * mean / MU_0,
        'N-MAE': 100.0 * mean / span,
        'RMSE': 1e3 * square / MU_0,
        'N-RMSE': 100.0 * square / span,
    }


def board_runs(folder: Path) -> list[dict[str, Any]]:
    """Return errors of a tracker over a board in held-out blocks, run by run; none without data.

    ``before_m`` and ``after_m`` are rms along the board, of blocks predicted from the others; the
    latter may be the larger, where a map that helped among the others does not in the block.
    Raises `BagError` or `FitError` as `anser_board.load` does.
    """
    runs = anser_board.load(folder) if folder.is_dir() else {}
    found = []
    for name, points in runs.items():
        error_map = learn_error_map(points, anser_board.places(), registers=True)
        found.append(
            {
                'name': name,
                'points': len(error_map.places),
                'before_m': error_map.before.judged,
                'after_m': error_map.after.judged,
                'across_m': error_map.before.out_of_plane or 0.0,
                'confirmed': error_map.is_confirmed,
                'shape': error_map.shape.describe(),
            }
        )
    return found
