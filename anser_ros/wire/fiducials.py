"""Reads lists of points of 3D Slicer (markups, ``.fcsv``)."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import BagError
from anser_ros.wire.text_files import read_text


def read_fiducials(path: Path) -> NDArray[np.float64]:
    """Return the positions (P, 3), m, of a list of fiducials.

    Raises
    ------
    BagError
        When the file has no table of fiducials.
    """
    lines = read_text(path).splitlines()
    rows = [line.split(',') for line in lines if line.strip() and not line.startswith('#')]
    try:
        places = np.array([[float(value) for value in row[1:4]] for row in rows])
    except ValueError as error:
        raise BagError(f'{path}: no table of fiducials: {error}') from error
    if not places.size or places.shape[1] != 3:
        raise BagError(f'{path}: no table of fiducials')
    return np.asarray(1e-3 * places)
