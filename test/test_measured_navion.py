"""Navion data: the parts on made-up plates, and the held-out figures where the data are there."""

import os
from pathlib import Path

import numpy as np
import pytest

from anser_ros.errors import FitError
from anser_ros.measured.navion_data import inner, load
from anser_ros.measured.navion_fit import EFFECTS, fit_plates
from anser_ros.measured.navion_held_out import (
    add_metal,
    chess_even,
    metal_places,
    others,
    prediction_error,
    rms,
    with_own_pose,
)
from anser_ros.measured.navion_plate import (
    HallSensorErrors,
    Plate,
    PlateData,
    Sources,
    predict_plane,
    rotation_matrices,
)
from anser_ros.measured.navion_report import predict_states
from anser_ros.measured.navion_sources import (
    locate_magnets,
    magnet_cloud,
    polarizability,
    scan_for_metal,
)
from anser_ros.measured.navion_states import fit_slew, join_states, split_states
from anser_ros.measured.navion_tool import tool_errors

SHARED = Path(os.environ.get('ANSER_SHARED', Path(__file__).parents[1].parent / 'shared'))
FOLDER = SHARED / 'measured' / 'navion'
needs_data = pytest.mark.skipif(
    not (FOLDER / 'navion_steady.csv').is_file(), reason=f'no measured data in {FOLDER}'
)
FOUND = frozenset(EFFECTS) - {'lever_arm'}
MAGNETS = np.array([[0.0, 0.28, 0.11], [-0.09, 0.29, -0.07], [0.09, 0.29, -0.07]])


def fit_effects(data, effects, n_metal):
    """Fit given effects and a given number of metal objects to all heights."""
    cloud = magnet_cloud(locate_magnets(data))
    fit = fit_plates(data, cloud, np.zeros((0, 3)), effects)
    for _ in range(n_metal):
        fit = add_metal(data, cloud, fit)
    return fit


def made_up_sources(metal: np.ndarray | None = None) -> Sources:
    moment = np.zeros((3, 3, 3))
    for k in range(3):
        moment[k, :, k] = 3000.0 * (np.array([0.0, -0.09, 0.0]) - MAGNETS[k]) / 0.4
    if metal is None:
        return Sources(MAGNETS, moment)
    bare = Sources(MAGNETS, moment)
    own = 40e-6 / (4e-7 * np.pi) * bare.field(metal[None])[0]
    return Sources(np.vstack([MAGNETS, metal]), np.concatenate([moment, own[None]]), 1)


def made_up_plate(rng: np.random.Generator, sources: Sources, errors: bool) -> PlateData:
    """Four heights of 7 x 7 sensors that read 18 uT of noise and, if asked, have every error."""
    side = np.linspace(-0.12, 0.12, 7)
    x, y = np.meshgrid(side, side - 0.09, indexing='ij')
    grid = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    height = np.array([-0.058, -0.029, 0.0, 0.058])
    plate = Plate(grid)
    sensors = HallSensorErrors(np.tile(np.eye(3), (len(grid), 1, 1)), np.zeros_like(grid))
    states = np.zeros((4, plate.n_state))
    if errors:
        turned = rotation_matrices(rng.normal(0.0, 0.04, grid.shape))
        gained = np.eye(3) + rng.normal(0.0, 0.02, (len(grid), 3, 1)) * np.eye(3)
        sensors = HallSensorErrors(gained @ turned, np.zeros_like(grid))
        states = rng.normal(0.0, 3e-4, states.shape)
        states -= states.mean(axis=0)
    field = [
        predict_plane(grid, h, sources, sensors, s) for h, s in zip(height, states, strict=True)
    ]
    return PlateData(height, grid, np.array(field) + rng.normal(0.0, 1.8e-5, (4, 3, len(grid), 3)))


class TestPlate:
    def test_motion_matches_differences(self) -> None:
        rng = np.random.default_rng(1)
        grid = rng.uniform(-0.1, 0.1, (6, 3)) * [1, 1, 0]
        plate = Plate(grid)
        shift = np.zeros_like(grid)
        state = np.zeros(plate.n_state)
        place, _ = plate.place(0.02, state, shift)
        moved, turned = plate.motion(0.02, state, place)
        for k in range(plate.n_state):
            step = np.zeros(plate.n_state)
            step[k] = 1e-6
            after, rotation = plate.place(0.02, step, shift)
            assert np.allclose((after - place) / 1e-6, moved[:, k], atol=1e-5)
            wanted = rotation_matrices(turned[:, k] * 1e-6)
            assert np.allclose(rotation, wanted, atol=1e-10)

    def test_gradient_matches_differences(self) -> None:
        sources = made_up_sources()
        points = np.array([[0.03, -0.1, 0.02], [-0.1, 0.0, -0.05]])
        slope = sources.gradient(points)
        for k in range(3):
            step = 1e-6 * np.eye(3)[k]
            change = (sources.field(points + step) - sources.field(points - step)) / 2e-6
            assert np.allclose(slope[:, :, k], change, rtol=1e-6, atol=1e-9)


class TestFit:
    @pytest.mark.long
    def test_a_clean_plate_gains_nothing(self) -> None:
        data = made_up_plate(np.random.default_rng(2), made_up_sources(), errors=False)
        cloud = magnet_cloud(MAGNETS)
        none = fit_plates(data, cloud, np.zeros((0, 3)), frozenset())
        for name in EFFECTS:
            fit = fit_plates(data, cloud, np.zeros((0, 3)), frozenset({name}))
            assert fit.log_evidence < none.log_evidence + 5.0, name

    @pytest.mark.long
    def test_errors_and_metal_are_found_and_predict_the_height_left_out(self) -> None:
        metal = np.array([0.14, -0.02, -0.08])
        data = made_up_plate(np.random.default_rng(3), made_up_sources(metal), errors=True)
        known = others(data, 1)
        plain = fit_effects(known, frozenset(), 0)
        fit = fit_effects(known, FOUND, 1)
        assert fit.log_evidence > plain.log_evidence + 1000.0
        assert np.linalg.norm(metal_places(fit)[0] - metal) < 5e-3
        alpha, odd = polarizability(fit.sources, 0)
        assert odd < 0.2
        assert np.trace(alpha) / 3 == pytest.approx(40e-6, rel=0.3)
        before, after = (rms(prediction_error(data, 1, f)) for f in (plain, fit))
        assert after < 0.5 * before  # the plate's own pose and bend stay unknown
        own, _ = with_own_pose(data, 1, fit)
        assert rms(own) < 3.5e-5

    def test_magnets_are_found(self) -> None:
        data = made_up_plate(np.random.default_rng(4), made_up_sources(), errors=False)
        assert np.allclose(locate_magnets(data), MAGNETS, atol=2e-3)

    def test_a_tool_is_tracked_from_a_cold_start(self) -> None:
        sources = made_up_sources()
        data = made_up_plate(np.random.default_rng(5), sources, errors=False)
        perfect = HallSensorErrors(np.tile(np.eye(3), (49, 1, 1)), np.zeros((49, 3)))
        found = tool_errors(data.field_t[2], sources, perfect, data.grid_m, 0.0)
        position, angle = found.rmse()
        assert position < 3e-3
        assert angle < np.radians(1.0)

    def test_unknown_effects_are_refused(self) -> None:
        data = made_up_plate(np.random.default_rng(6), made_up_sources(), errors=False)
        with pytest.raises(FitError, match='no such plate effect: magic'):
            fit_plates(data, MAGNETS, np.zeros((0, 3)), frozenset({'magic'}))

    def test_one_height_is_refused(self) -> None:
        data = made_up_plate(np.random.default_rng(7), made_up_sources(), errors=False)
        with pytest.raises(FitError, match='need plates at 2 heights or more, got 1'):
            fit_plates(data.select([0]), MAGNETS, np.zeros((0, 3)), frozenset())


class TestStates:
    SIGN = np.array([[a, b, c] for a in (1, -1) for b in (1, -1) for c in (1, -1)], dtype=float)

    def test_terms_join_to_the_states(self) -> None:
        reading = np.random.default_rng(8).normal(size=(8, 5, 3))
        assert np.allclose(join_states(split_states(reading, self.SIGN), self.SIGN), reading)

    def test_an_incomplete_design_is_refused(self) -> None:
        with pytest.raises(FitError, match='eight sign combinations'):
            split_states(np.zeros((8, 1, 3)), np.ones((8, 3)))

    def test_slew_is_found_and_steps_are_refused(self) -> None:
        time = np.arange(0.0, 16.0, 0.4)
        command = np.array([0.0, 5.0, 10.0, 15.0])
        current = 35.0 * np.array([[1.0] * 3, [-1.0] * 3, [1.0] * 3, [-1.0] * 3])
        since = np.stack([time - command[1], time - command[2]])
        ramp = np.clip((since - 0.25) * 36.0, 0.0, 70.0)
        reading = (35.0 - ramp[0] + ramp[1])[:, None, None] * np.ones((1, 2, 3))
        slew = fit_slew(time, reading, command, current)
        assert slew.delay_s == pytest.approx(0.25, abs=0.02)
        assert slew.rate_a_per_s == pytest.approx(36.0, rel=0.03)
        assert slew.settled_s(35.0) == pytest.approx(0.25 + 35.0 / 36.0, abs=0.04)
        steps = np.where(ramp[0] > 0, -1.0, 1.0) * np.where(ramp[1] > 0, -1.0, 1.0)
        with pytest.raises(FitError, match='middle of its ramp'):
            fit_slew(time, steps[:, None, None] * np.ones((1, 2, 3)), command, current)


class TestFiles:
    def test_a_missing_file_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(FitError, match=r'no such file: .*navion_steady\.csv'):
            load(tmp_path)

    @needs_data
    def test_a_cut_file_is_refused(self, tmp_path: Path) -> None:
        lines = (FOLDER / 'navion_steady.csv').read_text().splitlines()
        (tmp_path / 'navion_steady.csv').write_text('\n'.join(lines[:-1]))
        with pytest.raises(FitError, match='4355 rows, expected 4356'):
            load(tmp_path)


@needs_data
class TestMeasured:
    @pytest.mark.long
    def test_an_inner_height_from_the_others(self) -> None:
        data = load(FOLDER)
        held = inner(data)[0]
        known = [p for p in range(len(data.plane)) if p != held]
        part = others(data.coils, held)
        plain = prediction_error(data.coils, held, fit_effects(part, frozenset(), 0))
        fit = fit_effects(part, FOUND, 0)
        height = float(data.coils.height_m[held])
        states = predict_states(data, fit, known, height)
        assert rms(plain) > 0.35e-3
        assert rms(prediction_error(data.coils, held, fit)) < 0.10e-3
        assert rms(states - join_states(data.terms_t[held], data.sign)) < 0.18e-3

    @pytest.mark.long
    def test_metal_under_the_lowest_height_is_seen_from_above(self) -> None:
        data = load(FOLDER)
        above = others(data.coils, 0)
        cloud = magnet_cloud(locate_magnets(above))
        start = fit_plates(above, cloud, np.zeros((0, 3)), FOUND, robust=False)
        place, gain = scan_for_metal(above, start, 1.0)
        assert gain > 100.0
        fit = fit_plates(above, cloud, place, FOUND)
        distance = np.linalg.norm(metal_places(fit)[0] - [0.138, -0.013, -0.074])
        assert distance < 0.015
        assert rms(prediction_error(data.coils, 0, fit)) < 0.16e-3

    def test_halves_of_a_plate_share_no_sensor(self) -> None:
        even = chess_even(load(FOLDER).coils.grid_m)
        assert even.sum() == 61
        assert even.size == 121
