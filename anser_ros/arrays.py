"""Names the types of arrays that all packages use, by the kind of their values."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Single = NDArray[np.float32]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]
AnyArray = NDArray[np.generic]
