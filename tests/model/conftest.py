import jax
import pytest


@pytest.fixture(scope="module", autouse=True)
def compile_quickly():
    """Compiling takes most of the time of these tests, and their arithmetic is small."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
