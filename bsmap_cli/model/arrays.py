"""Arrays of the model, and the check of their shapes."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


def check(owner: object, **shapes: tuple[int | None, ...]) -> None:
    """Raise ValueError where an attribute's array has not the shape named (None: any length)."""
    for name, shape in shapes.items():
        got = np.shape(getattr(owner, name))
        if len(got) != len(shape) or any(s is not None and s != g for s, g in zip(shape, got, strict=True)):
            wanted = "(" + ", ".join("any" if s is None else str(s) for s in shape) + ")"
            raise ValueError(f"{type(owner).__name__}.{name} has shape {got}, wanted {wanted}")
