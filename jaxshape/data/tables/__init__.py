"""Procedural tables: dining, coffee and side tables, desks, trestles, pedestals and many more.

A table is drawn in the order of its modules: `tops`, `bases` (legs and pedestals of a top),
`storage` (drawers, shelves, attachments of desks), `family` (styles, frequencies, sizes).

The canonical frame is the same as for chairs: +y up, box centred at the origin. The long side of a
top is along x. A table with a front, such as a desk with drawers and a place to sit, faces +z; most
others look the same from both long sides, and square and round ones from all four.
"""

from jaxshape.data.tables.family import FREQUENCIES as FREQUENCIES
from jaxshape.data.tables.family import STYLES as STYLES
from jaxshape.data.tables.family import TABLES as TABLES
from jaxshape.data.tables.family import random_table as random_table
