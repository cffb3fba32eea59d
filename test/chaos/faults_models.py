"""Faults of what the field model is told, or made from."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import tampers
from fault import Fault, Off, nothing
from line import Tamper
from rig import BOARD_SEED, Rig

from anser_ros.field.model import EffectRecord, FieldModel
from anser_ros.field.nominal import nominal_model
from anser_ros.sessions.starting_model import board_of, is_snapshot, load_model, save_model
from anser_ros.simulation.world import manufactured


def _served(change: Callable[[Rig, FieldModel], FieldModel]) -> Callable[..., Off]:
    """Start field_model anew with a file that it should not have been given."""

    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        path = rig.folder / f'wrong_{time.monotonic_ns()}.yaml'
        save_model(path, change(rig, load_model(rig.model)))
        return _restarted(rig, model_file=path, baseline_at_start=True)

    return on


def _restarted(rig: Rig, node: str = 'field_model', **parameters: object) -> Off:
    restore = rig.restored(node)
    rig.restart(node, **parameters)
    return restore


def _other_board(rig: Rig, given: FieldModel) -> FieldModel:
    drawn = manufactured(rig.setup, np.random.default_rng(BOARD_SEED + 6))
    other = nominal_model(board_of(drawn))
    return replace(other, modes=None, flux_error_t=given.flux_error_t, provenance=given.provenance)


def _nominal(rig: Rig, _rng: np.random.Generator) -> Off:
    return _restarted(rig, model_file='nominal', baseline_at_start=True)


def _saved_near_metal(rig: Rig, _rng: np.random.Generator) -> Off:
    path = rig.folder / 'saved.yaml'
    rig.set_parameter('field_model', 'save_file', str(path))
    time.sleep(4.0)
    rig.call('field_model/save')
    if not path.is_file():
        return nothing
    if not is_snapshot(load_model(path, snapshot=True)):
        return _restarted(rig, model_file=path, refit=False)
    restore = rig.restored('field_model')
    rig.try_refused('field_model', model_file=path, refit=False)
    return restore


def _baseline_near_metal(rig: Rig, _rng: np.random.Generator) -> Off:
    restore = rig.restored('field_model')
    rig.call('field_model/set_baseline')
    return restore


def _doubled_effect(rig: Rig, _rng: np.random.Generator) -> Off:
    path = rig.folder / 'effects.yaml'
    record = EffectRecord('coil_gain', {'coil': 3, 'gain': 1.05, 'phase_deg': 0.0})
    save_model(path, replace(load_model(rig.model), effects=(record,)))
    return _restarted(rig, 'tracker', model_file=path)


def _gate(gate: float, make: Callable[[], Tamper]) -> Callable[..., Off]:
    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        rig.set_parameter('tracker', 'gate', gate)
        rig.line.put('gate', make())

        def off() -> None:
            rig.line.take_off('gate')
            rig.set_parameter('tracker', 'gate', 5.0)

        return off

    return on


MODELS = (
    Fault('other-board', 'the model of another board with the same names and tones',
          _served(_other_board), 5.0),
    Fault('moments-up', 'moments x 1.01', _served(
        lambda rig, m: replace(m, moments=1.01 * m.moments)), 5.0),
    Fault('moment-one', 'moments of one emitter x 1.02', _served(
        lambda rig, m: replace(m, moments=m.moments * np.where(
            np.arange(m.moments.shape[1]) == 3, 1.02, 1.0))), 5.0),
    Fault('model-shifted', 'all dipoles 2 mm to the side', _served(
        lambda rig, m: replace(m, positions=m.positions + [0.002, 0.0, 0.0])), 5.0),
    Fault('model-scaled', 'all dipoles in another unit', _served(
        lambda rig, m: replace(m, positions=1e3 * m.positions)), 5.0),
    Fault('nominal', 'nominal on a real board', _nominal, 5.0),
    Fault('saved-near-metal', 'the model saved near metal, loaded as a clean one',
          _saved_near_metal, 8.0, 'metal'),
    Fault('baseline-near-metal', 'set_baseline while metal is near', _baseline_near_metal, 8.0,
          'metal', spoils=True),
    Fault('doubled-effect', "the tracker's file has an effect that the model served has not",
          _doubled_effect, 4.0),
    *(Fault(f'gate-{gate:.0f}', f'gate set to {gate:g} live, and {what}', _gate(gate, make), 6.0)
      for gate, what, make in (
          (1e6, 'two coils swapped', lambda: tampers.swapped(0, 4)),
          (100.0, 'a gain of 3 % on all coils', lambda: tampers.gain(1.03, tampers.TOOL)),
          (20.0, 'a gain of 2 % on all coils', lambda: tampers.gain(1.02, tampers.TOOL)))),
)  # fmt: skip
"""Models that are wrong."""
