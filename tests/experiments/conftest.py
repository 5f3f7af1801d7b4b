"""Scripts in small: most of their time is the compiler's."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def quickly(compile_quickly):
    """All of these tests compile without optimisation."""
