import jaxtyping
import pytest


@pytest.fixture
def without_shape_checks():
    """Off where a test makes many chairs: they triple the time, and another test has them on."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)
