"""Holds the figures of the article's Tables II to V, in mm, degrees and mA/m as printed there."""

from collections.abc import Mapping

STATISTICS = ('RMSE', 'ME', 'PRC50', 'PRC95')
SENSORS = ('Y', 'Z')

Column = Mapping[str, Mapping[str, float]]
"""Figures by sensor and then by statistic."""


def _column(y: tuple[float, ...], z: tuple[float, ...]) -> Column:
    return {
        'Y': dict(zip(STATISTICS, y, strict=True)),
        'Z': dict(zip(STATISTICS, z, strict=True)),
    }


# Position errors of the article's new model without metal, mm.
TABLE_2_MM = {
    'Biot-Savart': _column((0.93, 0.76, 0.55, 2.04), (1.03, 0.93, 0.91, 1.69)),
    'data-driven': _column((0.28, 0.20, 0.13, 0.62), (0.23, 0.20, 0.18, 0.39)),
}
# Orientation errors of the same, degrees.
TABLE_2_DEG = {
    'Biot-Savart': _column((0.61, 0.45, 0.31, 1.43), (0.80, 0.71, 0.67, 1.32)),
    'data-driven': _column((0.23, 0.20, 0.17, 0.45), (0.21, 0.17, 0.15, 0.42)),
}
TABLE_3_FIELD = {
    'aluminium': {
        'training': {'MAE': 0.1377, 'N-MAE': 0.0085, 'RMSE': 0.1885, 'N-RMSE': 0.0116},
        'test': {'MAE': 0.2082, 'N-MAE': 0.0131, 'RMSE': 0.2854, 'N-RMSE': 0.0179},
    },
    'mu-metal': {
        'training': {'MAE': 0.7827, 'N-MAE': 0.0088, 'RMSE': 1.0817, 'N-RMSE': 0.0122},
        'test': {'MAE': 1.4106, 'N-MAE': 0.0160, 'RMSE': 1.8508, 'N-RMSE': 0.0210},
    },
}
"""Errors of the field over shields: mA/m, and percent of the range."""
# Position errors over the same shields, mm.
TABLE_3_MM = {
    'aluminium': _column((0.16, 0.11, 0.07, 0.32), (0.13, 0.11, 0.09, 0.27)),
    'mu-metal': _column((0.17, 0.12, 0.09, 0.36), (0.16, 0.14, 0.12, 0.29)),
}
# Position errors with the X-ray head below, without shield and with two of them, mm.
TABLE_4_MM = {
    'unshielded': _column((5.72, 5.28, 4.56, 9.39), (4.74, 4.37, 4.02, 7.82)),
    'aluminium': _column((0.31, 0.23, 0.16, 0.63), (0.46, 0.40, 0.36, 0.89)),
    'mu-metal': _column((0.23, 0.19, 0.16, 0.38), (0.51, 0.43, 0.33, 0.97)),
}
# Position errors between two measured planes over the X-ray head, mm.
TABLE_5_MM = {
    'uncompensated': _column((12.01, 11.71, 11.15, 17.22), (25.03, 22.87, 19.71, 46.21)),
    'compensated': _column((0.92, 0.89, 0.81, 1.33), (0.67, 0.65, 0.63, 0.94)),
    'compensated and corrected': _column((0.35, 0.34, 0.33, 0.51), (0.49, 0.47, 0.43, 0.73)),
}
