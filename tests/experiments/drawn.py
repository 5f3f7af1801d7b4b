"""Whether a figure shows something."""

from pathlib import Path

import numpy as np
from PIL import Image


def is_drawn(path: Path) -> bool:
    """Whether a picture has dark pixels, and is neither blank nor filled by one colour."""
    with Image.open(path) as image:
        grey = np.asarray(image.convert("L"))
    return bool(grey.min() < 128 and 0.005 < (grey < 250).mean() < 0.95)
