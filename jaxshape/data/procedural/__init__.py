"""What the families of procedural objects have in common.

An object is drawn in the order of these modules: `draw` (random choices), `primitives` (closed
surfaces), `boards` (seats and table tops), `pedestals` and `legs` (what carries them), `family`
(styles and how often each is drawn). The families themselves are `jaxshape.data.chairs` and
`jaxshape.data.tables`.
"""
