"""Procedural chairs: unlimited, deterministic training shapes that come with the library.

A chair is drawn in the order of its modules: `primitives` (closed surfaces), `seats`, `bases`,
`backs`, `arms`, `shells` and `upholstery` (the parts), `family` (styles, frequencies, sizes).
"""

from jaxshape.data.chairs.family import FREQUENCIES as FREQUENCIES
from jaxshape.data.chairs.family import STYLES as STYLES
from jaxshape.data.chairs.family import VOLUMINOUS as VOLUMINOUS
from jaxshape.data.chairs.family import random_chair as random_chair
