# SPDX-License-Identifier: BSD-3-Clause
"""Array types of all packages: `Array` of floats, `Index` of integers, `Mask` of booleans, `Grey` of an 8-bit image."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
Grey = NDArray[np.uint8]
