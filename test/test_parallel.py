"""Work that is shared among threads: in order, the same for any number of them."""

import threading

import numpy as np
import pytest

from anser_ros.diagnosis.problem import Whitener
from anser_ros.parallel import in_order, shared_among
from anser_ros.physics.dipole import dipole_field, flux_jacobian


def test_results_come_in_the_order_of_the_pieces_from_several_threads():
    met = threading.Barrier(2, timeout=60.0)

    def work(piece):
        met.wait()  # passes only where two threads are at it
        return piece**2, threading.current_thread().name

    with shared_among(2):
        found = in_order(work, range(4))
    assert [value for value, _ in found] == [0, 1, 4, 9]
    assert len({name for _, name in found}) == 2


def test_pieces_that_share_out_work_do_it_alone():
    with shared_among(2):
        found = in_order(lambda a: in_order(lambda b: a + b, range(3)), range(5))
    assert found == [[a, a + 1, a + 2] for a in range(5)]


def test_an_error_of_a_piece_is_the_caller_s_and_the_number_is_as_before():
    with pytest.raises(ZeroDivisionError), shared_among(3):
        in_order(lambda piece: 1 / piece, [1, 0, 2])
    names = in_order(lambda _: threading.current_thread().name, range(3))
    assert set(names) == {threading.current_thread().name}


def test_fields_and_whitened_values_are_the_same_bit_by_bit_for_any_number_of_threads():
    rng = np.random.default_rng(3)
    points, axes = rng.normal(size=(1300, 3)) + [0, 0, 3], rng.normal(size=(1300, 3))
    places, directions = rng.normal(size=(40, 3)), rng.normal(size=(40, 3))
    moments = rng.normal(size=(40, 3)) + 1j * rng.normal(size=(40, 3))
    white = Whitener.of(rng.random((70, 12)), rng.normal(size=(70, 12, 6)), 6)
    values = rng.normal(size=(70, 12, 5))

    def everything():
        jacobian = flux_jacobian(points, axes, None, places, directions, moments)
        return [*jacobian, dipole_field(points, places, directions, moments), white(values)]

    alone = everything()
    for count in (2, 3):
        with shared_among(count):
            for one, other in zip(alone, everything(), strict=True):
                np.testing.assert_array_equal(one, other)


def test_whitening_frame_by_frame_is_the_product_of_its_matrices():
    rng = np.random.default_rng(4)
    weight, values = rng.random((35, 12)), rng.normal(size=(35, 12, 2))
    white = Whitener.of(weight, rng.normal(size=(35, 12, 6)), 6)
    plain = values * weight[..., None]
    plain = plain - white.basis @ (white.inner @ (white.basis.transpose(0, 2, 1) @ plain))
    np.testing.assert_allclose(white(values), plain, rtol=1e-12)
    np.testing.assert_allclose(white(values[..., 0]), plain[..., 0], rtol=1e-12)
