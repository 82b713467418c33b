import numpy as np
from numpy.typing import NDArray

def class_means(image: NDArray[np.uint8], theta: int) -> tuple[float, float, int]: ...
