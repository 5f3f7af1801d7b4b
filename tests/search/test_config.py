"""Settings of a search refuse wrong values where they are made."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.search.config import RefineConfig

pytestmark = pytest.mark.usefixtures("unchecked_types")


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"objective": "balanced "}, "objective is 'balanced '; give 'balanced' or 'paper'"),
        ({"symmetry": "yes"}, "symmetry is 'yes'; give True or False"),
        ({"space": "white"}, "space is 'white'; give 'whitened' or 'raw'"),
        ({"precision": "float16"}, "precision is 'float16'; give 'float32' or 'bfloat16'"),
        ({"iterations": 0}, "iterations is 0; give a whole number, 1 or more"),
        ({"population": 2}, "population is 2; give a whole number, 3 or more"),
        ({"population": 17.0}, "population is 17.0; give a whole number"),
        ({"sigma0": 0.0}, "sigma0 is 0.0; give a number above 0"),
        ({"sigma0": None}, "sigma0 is None; give a number above 0"),
        ({"sigma0": float("nan")}, "sigma0 is nan"),
        ({"step_size": -1}, "step_size is -1; give a number above 0"),
        ({"bound": -1}, "bound is -1; give a number above 0"),
        ({"bound": float("inf")}, "bound is inf"),
        ({"prior_weight": -0.1}, "prior_weight is -0.1; give a number, 0 or more"),
        ({"tolerance": -1e-6}, "tolerance is -1e-06; give a number, 0 or more"),
        ({"target": float("nan")}, "target is nan"),
    ],
)
def test_wrong_values_are_refused(changed, message):
    with pytest.raises(ValueError, match=message):
        RefineConfig(**changed)


def test_numbers_of_numpy_and_ends_of_ranges_are_taken():
    RefineConfig(iterations=np.int64(1), population=3, sigma0=np.float32(0.1), tolerance=0)
    RefineConfig(step_size=1, bound=np.float64(2), prior_weight=0.0, target=-1.0)


def test_traced_numbers_are_not_checked():
    """Their values are unknown; whoever traces them knows what they are."""
    names = ("sigma0", "step_size", "bound", "prior_weight", "tolerance", "target")

    def total(x):
        config = RefineConfig(**dict.fromkeys(names, x))
        return sum(getattr(config, name) for name in names)

    assert jax.jit(total)(jnp.float32(-1)) == -6
