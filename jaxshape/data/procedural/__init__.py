"""Parts that the families of procedural objects share.

An object is drawn in the order of these modules: `draw` (random choices), `primitives` (closed
surfaces), `boards` (seats and table tops), `pedestals` and `legs` (their bases), `family` (styles
and their frequencies). The families themselves are `jaxshape.data.chairs` and
`jaxshape.data.tables`.
"""
