"""Which of several fitted explanations the diagnosis takes."""

from types import SimpleNamespace

import pytest

from anser_ros.diagnosis.choice import choose
from anser_ros.effects.effect import Family


def fitted(gain, family, complexity):
    effect = SimpleNamespace(family=family, rivals=lambda one, other: False)
    newest = SimpleNamespace(effect=effect, complexity=complexity)
    return gain, SimpleNamespace(newest=newest, misfit=1.0)


@pytest.mark.parametrize(('best', 'share', 'taken'), [
    (Family.MOVING_METAL, 0.99, Family.STEADY),  # a course of metal follows a drift, nearly
    (Family.METAL_AT_REST, 0.99, Family.STEADY),
    (Family.MOVING_METAL, 0.95, Family.MOVING_METAL),
    (Family.STEADY, 0.99, None),  # the richer one, as both are no metal
])  # fmt: skip
def test_metal_gives_way_to_something_simpler_that_explains_nearly_as_much(best, share, taken):
    rich, plain = fitted(1e6, best, 60), fitted(share * 1e6, Family.STEADY, 2)
    _, found = choose([plain, rich])
    assert found is rich[1] if taken is None else found.newest.effect.family is taken
