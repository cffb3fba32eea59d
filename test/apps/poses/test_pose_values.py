"""Parameters of effects on poses as the report words them."""

import pytest

from anser_ros.apps.poses.cli.pose_session import sizes


@pytest.mark.parametrize(
    ('parameters', 'sigmas', 'lines'),
    [
        (
            {'offset_s': 0.03005, 'middle_s': 7.0}, {'offset_s': 5.8e-5},
            ['offset: 30.050 ± 0.058 ms'],
        ),
        ({'rate_ppm': -1118.2}, {'rate_ppm': 38.4}, ['rate: -1118 ± 38 ppm']),
        ({'scale': 1.01532}, {'scale': 0.0012}, ['scale: 1.0153 ± 0.0012']),
        (
            {'kind': 'linear', 'degree': 1, 'rms_m': 0.002, 'coefficients_mm': [1.0] * 30},
            {'rms_m': 1e-4}, ['kind: linear', 'rms: 2.00 ± 0.10 mm'],
        ),
        (
            {'rms_s': 0.0069, 'by_sensor': {'tip': 0.0071}}, {'rms_s': 0.0002},
            ['rms: 6.90 ± 0.20 ms', 'by sensor: tip 7.10 ms'],
        ),
        ({'fraction': 0.02, 'by_sensor': {'tip': 3}}, {}, ['share: 2.00 %', 'by sensor: tip 3']),
        ({'t_start_s': 6.73, 'sensors': ['tip']}, {'t_start_s': 0.5},
         ['start: 6.7 s', 'sensors: [tip]']),
    ],
)  # fmt: skip
def test_sizes_are_told_in_the_units_of_a_clinic(parameters, sigmas, lines):
    assert [line.replace('\xa0', ' ') for line in sizes(parameters, sigmas)] == lines
