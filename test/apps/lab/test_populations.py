"""Populations of sensors' errors, as reports show them."""

import matplotlib.pyplot as plt
import numpy as np

from anser_ros.cli.calibrate import population_figure, population_table, populations
from anser_ros.field.model import EffectRecord


def record(name, values, channels=(0, 1, 2)):
    sigma = np.full(np.shape(values), 1e-4).tolist()
    return EffectRecord(
        name, {'spread': 2e-3, 'channels': list(channels), 'values': values, 'uncertainty': sigma}
    )


GAINS = record('sensor_gain_spread', [[1.002, 0.001], [0.999, 0.0], [1.0, -0.003]])
PLACES = record('sensor_place_spread', [[1e-4, 0.0, -2e-4], [0.0, 3e-5, 0.0]], (1, 4))
PICKUP = record('sensor_pickup_spread', [[3e-9, 4e-9, 0.0, 0.0], [0.0] * 4, [1e-9] * 4])
SINGLE = EffectRecord('sensor_gain', {'channel': 3, 'gain': 1.1})


def test_every_channel_has_its_values_and_their_sigma():
    head, rows = population_table([GAINS, SINGLE, PLACES])
    assert head[1] == 'sensor_gain_spread in phase, %'
    assert head[-1] == 'sensor_place_spread z, mm'
    assert [row[0] for row in rows] == ['0', '1', '2', '4']
    assert rows[0][1:4] == ['0.2000 ± 0.0100', '0.1000 ± 0.0100', '']
    assert rows[1][3:] == ['0.1000 ± 0.1000', '0.0000 ± 0.1000', '-0.2000 ± 0.1000']


def test_many_values_of_a_channel_are_summed_up():
    head, rows = population_table([PICKUP])
    assert head == ['channel', 'sensor_pickup_spread rms, nT']
    assert rows[0][1].startswith('2.5000 ±')


def test_the_picture_has_a_panel_for_each_population():
    figure = population_figure([GAINS, SINGLE, PLACES])
    try:
        titles = [panel.get_title() for panel in figure.axes]
        assert titles == ['sensor_gain_spread: 0.2 %', 'sensor_place_spread: 2 mm']
    finally:
        plt.close(figure)


def test_without_a_population_there_is_nothing_to_show():
    assert populations([SINGLE]) == []
    assert population_table([SINGLE])[1] == []
    assert population_figure([SINGLE]) is None
