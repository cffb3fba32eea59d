"""Runs the article's experiments on recordings: Tables II to V, and the data of its figures."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.error_map import learn_error_map
from anser_ros.calibration.result import Calibration
from anser_ros.experiments.bound import position_bound
from anser_ros.experiments.error_maps import BoardRun, board_folder, board_runs
from anser_ros.experiments.methods import (
    article_model,
    centres_extension,
    drawn_model,
    expecting,
    our_model,
)
from anser_ros.experiments.recordings import (
    HEAD_DISTANCES_CM,
    MATERIALS,
    Recordings,
    checkerboard,
    with_sensors,
)
from anser_ros.experiments.tracking_errors import SensorErrors, track
from anser_ros.field.model import FieldModel
from anser_ros.physics.constants import MU_0
from anser_ros.sessions.session import Session
from anser_ros.simulation.recording import STATIC_NOISE_T

Array = NDArray[np.float64]
Errors = dict[str, SensorErrors]


@dataclass
class Results:
    """Holds the results of all experiments.

    Attributes
    ----------
    origin : str
        Who simulated the recordings.
    tracking : dict
        Errors by experiment, method and sensor.
    fields : dict
        The article's field metrics by material, method and set.
    bounds : dict
        Cramer-Rao bound of each sensor by experiment, m.
    models : dict
        Figures of our model's choice by the recording that it was trained on.
    corrections : dict
        The error map of Table V in words, by method and sensor.
    board_runs : list of BoardRun
        Error maps of a real tracker's positions; the only measured data here.
    """

    origin: str
    tracking: dict[str, dict[str, Errors]] = field(default_factory=dict)
    fields: dict[str, dict[str, dict[str, dict[str, float]]]] = field(default_factory=dict)
    bounds: dict[str, dict[str, float]] = field(default_factory=dict)
    models: dict[str, str] = field(default_factory=dict)
    corrections: dict[str, dict[str, str]] = field(default_factory=dict)
    board_runs: list[BoardRun] = field(default_factory=list)

    def document(self) -> dict[str, Any]:
        """Return the figures as plain data."""
        return {
            'schema': 'anser_paper/1',
            'origin': self.origin,
            'tracking': {
                experiment: {
                    method: {
                        sensor: {
                            'position_mm': e.millimetres(),
                            'orientation_deg': e.degrees(),
                            'tracked_fraction': e.tracked_fraction,
                        }
                        for sensor, e in errors.items()
                    }
                    for method, errors in methods.items()
                }
                for experiment, methods in self.tracking.items()
            },
            'fields': self.fields,
            'bounds_m': self.bounds,
            'models': self.models,
            'corrections': self.corrections,
            'measured_board': [asdict(run) for run in self.board_runs],
        }


Progress = Callable[[str, float], None]


class Study:
    """Runs the experiments one by one, and keeps what several of them need.

    Parameters
    ----------
    recordings : Recordings
    progress : callable, optional
        Called with the experiment's name and the finished share.
    """

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
        return drawn_model(self.factory, [self.factory])

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

    def _ours(self, name: str, *sessions: Session) -> Calibration:
        calibration = our_model(sessions)
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

    def new_model(self) -> None:
        """Run Table II and Fig. 5: the model without metal, tested with tool B."""
        test = self.recordings.load('midplane_tool_b')
        ours = self.factory_calibration.model
        small = article_model(self.factory, centres_extension(self.factory))
        self.results.tracking['table_2'] = {
            'drawing': track(test, self.drawing, in_phase=True),
            'article': track(test, article_model(self.factory), in_phase=True),
            'article, layer over the centres': track(test, small, in_phase=True),
            'ours': track(test, ours),
        }
        self._bound('table_2', test, ours)

    def shields(self) -> None:
        """Run Table III and Fig. 6: half of the points over a plate predict the other half."""
        for material in MATERIALS:
            training, test = checkerboard(self.recordings.shield(material))
            article, ours = (
                article_model(training),
                self._ours(f'{material}, half', training).model,
            )
            self.results.fields[material] = {
                method: {
                    'training': field_errors(training, model),
                    'test': field_errors(test, model),
                }
                for method, model in (('article', article), ('ours', ours))
            }
            self.results.tracking[f'table_3 {material}'] = {
                'article': track(test, article, in_phase=True),
                'ours': track(test, ours),
            }
            self._bound(f'table_3 {material}', test, ours)

    def head(self) -> None:
        """Run Figs. 7 and 8: the X-ray head comes closer, without compensation."""
        # What bends the field is not in this model; it only knows that it may be wrong.
        ours = self._bent(self.factory_calibration.model)
        for distance in HEAD_DISTANCES_CM:
            test = self.recordings.load(f'c_arm_{distance:02d}cm_tool_b')
            self.results.tracking[f'fig_7 {distance} cm'] = {
                'drawing': track(test, self.drawing, in_phase=True),
                'ours': track(test, ours),
            }

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
            self.results.tracking[f'table_4 {material}'] = {
                'article': track(test, article, in_phase=True),
                'ours': track(test, ours),
            }
        nearest = f'fig_7 {HEAD_DISTANCES_CM[-1]} cm'
        self.results.tracking['table_4 unshielded'] = self.results.tracking[nearest]

    def compensation(self) -> None:
        """Run Table V and Fig. 10: two planes over the head predict the one between them."""
        session = self.recordings.load('collimator_tool_a')
        training = outer_planes(session)
        article, ours = article_model(training), self._ours('collimator', training).model
        bottom = self.recordings.load('collimator_bottom_tool_b')
        test = self.recordings.load('collimator_midplane_tool_b')
        compensated = {
            'article': track(test, article, in_phase=True),
            'ours': track(test, ours),
        }
        self.results.tracking['table_5 uncompensated'] = {
            'drawing': track(test, self.drawing, in_phase=True),
            'ours': track(test, self._bent(self.factory_calibration.model)),
        }
        self.results.tracking['table_5 compensated'] = compensated
        known = {
            'article': track(bottom, article, in_phase=True),
            'ours': track(bottom, ours),
        }
        self.results.tracking['table_5 compensated and corrected'] = {
            method: self._corrected(method, known[method], errors)
            for method, errors in compensated.items()
        }
        self._bound('table_5 compensated', test, ours)

    def error_maps(self) -> None:
        """Run the error map of a tracker that gives positions only."""
        self.results.board_runs = board_runs(board_folder())

    def _corrected(self, method: str, known: Errors, errors: Errors) -> Errors:
        """Return errors after an error map learnt in the bottom plane, if it helps there."""
        out, words = {}, {}
        for sensor, found in errors.items():
            error_map = learn_error_map(known[sensor].tracked, known[sensor].true)
            words[sensor] = (
                f'{error_map.shape.describe()} (bottom plane, held out: '
                f'{1e3 * error_map.before_m:.3f} mm without a map, '
                f'{1e3 * error_map.after_m:.3f} mm with)'
            )
            out[sensor] = found.corrected(error_map.apply(found.tracked))
        self.results.corrections[method] = words
        return out


def outer_planes(session: Session) -> Session:
    """Return the recording of a stack of coils without those of its middle plane."""
    tool = session.tools[0]
    heights = tool.sensors.position[:, 2]
    outer = np.abs(heights - np.median(heights)) > 0.25 * np.ptp(heights)
    return with_sensors(
        session, [n for n, keep in zip(tool.sensors.name, outer, strict=True) if keep]
    )


def field_errors(session: Session, model: FieldModel) -> dict[str, float]:
    """Return the in-phase errors of the field over all sensors, emitters and measured poses.

    They are those of the article's equation (8): MAE and RMSE in mA/m, N-MAE and N-RMSE in percent
    of the range of the measured values.
    """
    tool = session.tools[0]
    points, axes = tool.placed()
    used = tool.usable
    lengths = np.broadcast_to(tool.sensors.length, used.shape)[used]
    measured = tool.flux[used].real
    error = measured - model.flux(points[used], axes[used], lengths).real
    span = float(np.ptp(measured))
    mean, square = float(np.abs(error).mean()), float(np.sqrt((error**2).mean()))
    return {
        'MAE': 1e3 * mean / MU_0,
        'N-MAE': 100.0 * mean / span,
        'RMSE': 1e3 * square / MU_0,
        'N-RMSE': 100.0 * square / span,
    }
