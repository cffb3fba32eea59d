"""The committed bags: small, readable, and remade by the command that the README names."""

from pathlib import Path

import numpy as np
import pytest

from anser_ros.cli.main import main
from anser_ros.sessions.session import load_session

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[1]
NAMES = ('factory', 'moving', 'metal', 'scan')


@pytest.fixture(scope='module')
def remade(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp('bags')
    setup = ROOT / 'config' / 'demo_setup.yaml'
    assert main(['bags', '--setup', str(setup), '--out', str(folder)]) == 0
    return folder


@pytest.mark.parametrize('name', NAMES)
def test_bag_is_small_and_is_what_the_command_makes(remade, name):
    committed = ROOT / 'bags' / f'{name}.mcap'
    assert committed.stat().st_size < 2_000_000
    old, new = load_session(committed), load_session(remade / f'{name}.mcap')
    assert old.setup == new.setup
    for a, b in zip([*old.tools, old.reference], [*new.tools, new.reference], strict=True):
        # Another BLAS sums in another order; float32 rounds what is left.
        np.testing.assert_allclose(a.flux, b.flux, rtol=1e-6, atol=1e-15)
        np.testing.assert_allclose(a.position, b.position, atol=1e-12)
        assert a.usable.all()
