"""Arrays by the type of their entries, whose shapes are stated where they are used; operators."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Indices = NDArray[np.int32]
Mask = NDArray[np.bool_]
# a linear map, applied to a vector
Operator = Callable[[Vector], Vector]
