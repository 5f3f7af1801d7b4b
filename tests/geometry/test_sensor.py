"""The three forms in which the noise of a depth sensor is used say the same."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.geometry import sensor


def test_the_deviation_is_that_of_noise_and_of_rounding_to_steps():
    """A uniform error of one step has a variance of a twelfth of its square."""
    together = np.hypot(sensor.AXIAL, sensor.STEP / np.sqrt(12))
    assert sensor.DEVIATION == pytest.approx(together, rel=0.02)
    assert sensor.SPREAD == pytest.approx(3 * sensor.AXIAL + sensor.STEP / 2, rel=0.12)


def test_what_the_sensor_returns_deviates_as_much_as_is_said():
    rng = np.random.default_rng(0)
    for depth in (1.0, 2.0, 4.0):
        noisy = depth + rng.normal(0, sensor.AXIAL * depth**2, 100_000)
        stepped = 1 / (sensor.STEP * np.rint(1 / (sensor.STEP * noisy)))
        off = stepped - depth
        assert off.std() == pytest.approx(
            float(sensor.depth_deviation(jnp.float32(depth))), rel=0.1
        )
        assert np.mean(np.abs(off) < sensor.tolerance(np.full(1, depth))) > 0.99


def test_near_things_keep_half_a_millimetre_and_planes_five():
    assert float(sensor.depth_deviation(jnp.float32(0.1))) == pytest.approx(5e-4)
    z = np.linspace(0.4, 5)
    assert (sensor.tolerance(z) >= 3 * sensor.AXIAL * z**2).all()
    assert (np.diff(sensor.tolerance(z)) > 0).all()
    assert sensor.tolerance(np.zeros(1))[0] == 5e-3
