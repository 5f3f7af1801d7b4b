"""Marks of single parameters of a test."""

from functools import partial

import pytest

slow = partial(pytest.param, marks=pytest.mark.slow)
"""A parameter with which a test is slow: it runs with `-m slow`."""
