"""The article's experiments, run on recordings: Tables II to V and what its figures show."""

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

Array = NDArray[np.float64]
Errors = dict[str, SensorErrors]

STATIC_NOISE_T = 30e-12
"""Flux noise of a static point, rms a component, as the recordings say; for the bound only."""
METHODS = ('drawing', 'article', 'ours')


@dataclass
class Results:
    """Everything that was found.

    Attributes
    ----------
    origin : str
        Whose simulation the data is.
    tracking : dict
        By experiment, then method: errors by sensor.
    fields : dict
        By material, then method, then set: the article's field metrics.
    bounds : dict
        By experiment: the Cramer-Rao bound of each sensor, m.
    models : dict
        By what they were trained on: how our model was chosen.
    corrections : dict
        By method, then sensor: the error map of Table V, in words.
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
        """The figures as plain data."""
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
    """Runs the experiments one by one; what several need is made once.

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
        """Tool A in clean surroundings."""
        return self.recordings.load('factory_tool_a')

    @cached_property
    def factory_calibration(self) -> Calibration:
        """Our model of the clean board."""
        return self._ours('factory_tool_a', self.factory)

    @cached_property
    def drawing(self) -> FieldModel:
        """Biot-Savart of the drawing, one gain an emitter from the clean recording."""
        return drawn_model(self.factory, [self.factory])

    def run(self) -> Results:
        """All experiments."""
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
            f'{calibration.n_measurements} readings an emitter, '
            f'held out {1e12 * calibration.held_out.score_t:.0f} pT with the pose marginalised'
        )
        return calibration

    def _bent(self, model: FieldModel) -> FieldModel:
        """A model for a field that it does not know the distortion of."""
        return expecting(model, self.drawing.flux_error_t)

    def _bound(self, experiment: str, session: Session, model: FieldModel) -> None:
        tool = session.tools[0]
        limits = position_bound(tool, model, STATIC_NOISE_T)
        self.results.bounds[experiment] = {
            name.rsplit('/', 1)[-1].upper(): float(limit)
            for name, limit in zip(tool.sensors.name, limits, strict=True)
        }

    def new_model(self) -> None:
        """Table II and Fig. 5: the board's own model, tested with tool B."""
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
        """Table III and Fig. 6: half of the points over a plate predict the other half."""
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
        """Figs. 7 and 8: the X-ray head comes closer, and nothing compensates."""
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
        """By material: the article's model and ours, from all points over the plate."""
        out = {}
        for material in MATERIALS:
            session = self.recordings.shield(material)
            out[material] = (article_model(session), self._ours(f'{material}, all', session).model)
        return out

    def shields_and_head(self) -> None:
        """Table IV and Fig. 9: models with the plate and without the head, tested with both."""
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
        """Table V and Fig. 10: two planes over the head predict the one between them."""
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
        """The classic error map, for a tracker that gives positions only."""
        self.results.board_runs = board_runs(board_folder())

    def _corrected(self, method: str, known: Errors, errors: Errors) -> Errors:
        """Positions corrected with what the bottom plane says, where that helps there."""
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
    """The recording of a stack of coils without those of its middle plane."""
    tool = session.tools[0]
    heights = tool.sensors.position[:, 2]
    outer = np.abs(heights - np.median(heights)) > 0.25 * np.ptp(heights)
    return with_sensors(
        session, [n for n, keep in zip(tool.sensors.name, outer, strict=True) if keep]
    )


def field_errors(session: Session, model: FieldModel) -> dict[str, float]:
    """The article's equation (8) over all sensors and emitters, in phase, at the measured poses.

    MAE and RMSE in mA/m, N-MAE and N-RMSE in percent of the range of the measured values.
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
