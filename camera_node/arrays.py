# SPDX-License-Identifier: BSD-3-Clause
"""Array types of all packages: `Array` holds numbers, `Index` rows of other arrays, `Mask` truth, `Grey` an image."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
Grey = NDArray[np.uint8]
