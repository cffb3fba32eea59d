"""The uncertainty that travels beside a model: packed, read again, refused when broken."""

import numpy as np
import pytest

from anser_ros.errors import LayoutError
from anser_ros.wire.points import ModelError, decode_model_error, encode_model_error

SEED = 51


def test_model_error_survives_its_message(rng):
    modes = rng.normal(size=(4, 6, 3)) + 1j * rng.normal(size=(4, 6, 3))
    modes[:, ::2] = 0.0
    modes[1] = 0.0
    fields, step, data = encode_model_error(ModelError(3e-11, modes))
    back = decode_model_error(fields, step, len(data) // step, data, 6, 3)
    np.testing.assert_allclose(back.modes, modes, rtol=1e-6)
    assert back.flux_error_t == pytest.approx(3e-11)
    assert not back.follows
    fields, step, data = encode_model_error(ModelError(3e-11, modes, follows=True))
    assert decode_model_error(fields, step, len(data) // step, data, 6, 3).follows
    fields, step, data = encode_model_error(ModelError(1e-12, np.zeros((0, 6, 3), complex)))
    assert decode_model_error(fields, step, 1, data, 6, 3).modes.shape == (0, 6, 3)


def test_model_errors_that_are_none_are_refused(rng):
    modes = np.ones((2, 6, 3), complex)
    fields, step, data = encode_model_error(ModelError(3e-11, modes))
    width = len(data) // step
    for arguments, word in [
        ((fields[:-1], step, width, data, 6, 3), 'no model uncertainty'),
        ((fields, step, width, data, 6, 4), 'no model uncertainty'),
        ((fields, step, width, data[:-1], 6, 3), 'do not fit'),
        ((fields, step, 0, b'', 6, 3), 'do not fit'),
        ((fields, step, width, data, 5, 3), 'dipole 5 of 5'),
    ]:
        with pytest.raises(LayoutError, match=word):
            decode_model_error(*arguments)
    for wrong, word in [(np.nan, 'not finite'), (-1.0, 'not be negative')]:
        fields, step, data = encode_model_error(ModelError(wrong, modes))
        with pytest.raises(LayoutError, match=word):
            decode_model_error(fields, step, width, data, 6, 3)
    with pytest.raises(LayoutError, match='must be'):
        encode_model_error(ModelError(0.0, np.ones((2, 3), complex)))
    fields, step, data = encode_model_error(ModelError(1e-12, np.ones((65000, 1, 1), complex)))
    with pytest.raises(LayoutError, match='too many'):
        decode_model_error(fields, step, 65000, data, 60000, 1)
