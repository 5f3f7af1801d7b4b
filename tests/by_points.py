"""The measurement of a map whose keyframes are fused by points, for tests that count them."""

from jaxshape.geometry.fusion import Measurement
from jaxshape.mapping.config import MappingConfig
from jaxshape.mapping.map.state import MapState, assemble


def by_points(prior, state: MapState) -> Measurement:
    """All keyframes where they are now, by the paper's points."""
    mapping = MappingConfig(fusion="points")
    measurement = assemble(prior, state.place, state.keyframes, state.view, mapping).measurement
    assert isinstance(measurement, Measurement)
    return measurement
