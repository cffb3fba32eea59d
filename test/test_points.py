"""The point layouts: packed as the interface says, read by name and offset, refused if broken."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anser_ros.errors import LayoutError
from anser_ros.wire.cdr import cloud_bytes, read_cloud
from anser_ros.wire.points import (
    DROPPED,
    FLOAT32,
    MOST_POINTS,
    SATURATED,
    STALE,
    DipolePoints,
    FluxPoints,
    ModelError,
    decode_field_model,
    decode_flux,
    decode_model_error,
    encode_field_model,
    encode_flux,
    encode_model_error,
    flux_fields,
)


def flux_points(sensors: int = 4, emitters: int = 8) -> FluxPoints:
    rng = np.random.default_rng(3)
    flux = rng.normal(size=(sensors, emitters, 2)).astype(np.float32).astype(float)
    geometry = rng.normal(size=(sensors, 6)).astype(np.float32).astype(float)
    geometry[0] = np.nan
    return FluxPoints(
        channel=np.arange(sensors) * 3, flags=np.arange(sensors) % 8,
        flux=flux[..., 0] + 1j * flux[..., 1], position=geometry[:, :3], axis=geometry[:, 3:],
    )  # fmt: skip


def assert_same(a: FluxPoints, b: FluxPoints) -> None:
    for name in ('channel', 'flags', 'flux', 'position', 'axis'):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_flag_bits_are_those_that_others_write_and_read():
    assert (SATURATED, STALE, DROPPED) == (1, 2, 4)


def test_fluxes_have_the_layout_of_the_interfaces_and_are_read_in_any_other():
    points = flux_points()
    fields, step, data = encode_flux(points)
    assert step == 92
    assert [f[0] for f in fields][:8] == ['x', 'y', 'z', 'nx', 'ny', 'nz', 'channel', 'flags']
    assert fields[8] == ('coil0_re', 28, 7, 1)
    assert fields[-1] == ('coil7_im', 88, 7, 1)
    assert_same(decode_flux(fields, step, 4, data), points)
    padded = b''.join(b'\xff' * 6 + data[i * step : (i + 1) * step] for i in range(4))
    moved = [(n, o + 6, t, c) for n, o, t, c in reversed(fields)] + [('rgb', 0, 2, 1)]
    assert_same(decode_flux(moved, step + 6, 4, padded), points)
    kinds = {4: '<u2', 7: '<f4'}
    record = np.dtype({'names': [f[0] for f in fields], 'offsets': [f[1] for f in fields],
                       'formats': [kinds[f[2]] for f in fields], 'itemsize': step})  # fmt: skip
    swapped = np.frombuffer(data, record).astype(record.newbyteorder('>'))
    assert_same(decode_flux(fields, step, 4, swapped.tobytes(), True), points)


def test_field_model_layout():
    rng = np.random.default_rng(0)
    model = DipolePoints(
        rng.normal(size=(5, 3)), rng.normal(size=(5, 3)),
        rng.normal(size=(5, 8)) + 1j * rng.normal(size=(5, 8)),
    )  # fmt: skip
    fields, step, data = encode_field_model(model)
    assert step == 8 * 22
    assert [f[0] for f in fields][:8] == ['x', 'y', 'z', 'ux', 'uy', 'uz', 'm0_re', 'm0_im']
    back = decode_field_model(fields, step, 5, data)
    np.testing.assert_array_equal(back.moments, model.moments)
    np.testing.assert_array_equal(back.positions, model.positions)


def test_a_field_model_with_nan_is_refused():
    model = DipolePoints(np.full((2, 3), np.nan), np.ones((2, 3)), np.ones((2, 1), complex))
    with pytest.raises(LayoutError, match='not finite'):
        decode_field_model(*shuffle(encode_field_model(model), 2))


def shuffle(encoded, width):
    fields, step, data = encoded
    return fields, step, width, data


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (lambda f, s, w, d: ([x for x in f if x[0] != 'channel'], s, w, d), "'channel'"),
        (lambda f, s, w, d: ([x for x in f if x[0] != 'coil3_im'], s, w, d), "'coil3_im'"),
        (lambda f, s, w, d: ([x for x in f if 'coil' not in x[0]], s, w, d), "'coil0_re'"),
        (lambda f, s, w, d: (f, s, w, d[:-1]), 'need 368 bytes, got 367'),
        (lambda f, s, w, d: (f, s, w + 1, d), 'bytes'),
        (lambda f, s, w, d: (f, 0, w, d), 'do not make a cloud'),
        (lambda f, s, w, d: (f + [('x', 0, 7, 1)], s, w, d), 'twice'),
        (lambda f, s, w, d: (f + [('y2', 90, 7, 1)], s, w, d), 'leaves the point'),
        (lambda f, s, w, d: (f + [('y2', 0, 77, 1)], s, w, d), 'datatype 77'),
        (lambda f, s, w, d: (f, s, w, d[:92] * 4), 'channel appears twice'),
    ],
)
def test_a_broken_cloud_is_refused(change, message):
    with pytest.raises(LayoutError, match=message):
        decode_flux(*change(*shuffle(encode_flux(flux_points()), 4)))


@pytest.mark.filterwarnings('error')
def test_what_is_not_finite_is_read_as_it_is():
    flux = np.full((2, 3), complex(np.inf, 1.0))
    flux[1] = complex(-1.0, np.nan), complex(np.nan, -np.inf), 0.0
    nothing = np.full((2, 3), np.nan)
    points = FluxPoints(np.arange(2), np.zeros(2, int), flux, nothing, nothing)
    fields, step, data = encode_flux(points)
    read = decode_flux(fields, step, 2, data).flux
    np.testing.assert_array_equal(read.real, flux.real)
    np.testing.assert_array_equal(read.imag, flux.imag)
    changed = [(n, o, FLOAT32 if n == 'channel' else t, c) for n, o, t, c in fields]
    changed = [(n, 28 if n == 'channel' else o, t, c) for n, o, t, c in changed]
    with pytest.raises(LayoutError, match="'channel' holds"):
        decode_flux(changed, step, 2, data)


FIELD = st.tuples(
    st.sampled_from(['x', 'y', 'z', 'nx', 'channel', 'flags', 'coil0_re', 'coil0_im', '']),
    st.integers(-4, 200), st.integers(0, 12), st.integers(0, 3),
)  # fmt: skip


@settings(max_examples=150, deadline=None)
@given(
    st.lists(FIELD, max_size=12), st.integers(-1, 200), st.integers(-1, 5), st.binary(max_size=400)
)
def test_hostile_clouds_raise_only_layout_errors(fields, step, width, data):
    for decode in (decode_flux, decode_field_model):
        with pytest.raises(LayoutError):
            decode(fields, step, width, data)


def test_more_points_than_channels_are_refused_before_they_are_read():
    fields, step = flux_fields(8)
    count = MOST_POINTS + 1
    with pytest.raises(LayoutError, match=f'{count} points are refused'):
        decode_flux(fields, step, count, bytes(step * count))


@pytest.mark.parametrize('order', ['<', '>'])
def test_a_cloud_is_read_as_the_middleware_reads_it(order):
    """Of either byte order; what is cut off anywhere is refused, and so are absurd counts."""
    fields, step, data = encode_flux(flux_points())
    whole = cloud_bytes(5, 'a frame of any length', fields, step, len(data) // step, data)
    if order == '>':
        whole = swapped(whole, len(fields))
    cloud = read_cloud(whole)
    assert cloud.header == ((0, 5), 'a frame of any length')
    assert (cloud.height, cloud.width, cloud.point_step) == (1, len(data) // step, step)
    assert (cloud.fields, bytes(cloud.data), cloud.is_bigendian) == (fields, data, False)
    for end in range(4, len(whole) - 1):
        with pytest.raises(LayoutError, match=r'no cloud in|ends after'):
            read_cloud(whole[:end])


def swapped(cloud, n_fields):
    """Return a serialised cloud with its words in the other byte order."""
    body, place = bytearray(cloud[4:]), 0

    def turn(count=1):
        nonlocal place
        place += -place % 4
        for at in range(place, place + 4 * count, 4):
            body[at : at + 4] = body[at : at + 4][::-1]
        place += 4 * count
        return int.from_bytes(body[place - 4 : place], 'big')

    turn(2)
    size = turn()
    place += size
    turn(3)
    for _ in range(n_fields):
        size = turn()
        place += size
        turn()
        place += 1
        turn()
    place += 1
    turn(3)
    return b'\x00\x00\x00\x00' + bytes(body)


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
