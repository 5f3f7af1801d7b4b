import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.model import convolution
from jaxshape.model.convolution import downsample, upsample

BATCH = 5
COARSE = (2, 3, 1)  # no two axes alike
FINE = (4, 6, 2)

# Fewer than 8 output channels are upsampled by one form, the others by another.
CHANNELS = [(3, 2), (8, 3)]


def random_array(*shape, seed=0):
    return jnp.float32(np.random.default_rng(seed).normal(size=shape))


def example(channels):
    fine, coarse = channels
    return (
        random_array(BATCH, *FINE, fine),
        random_array(BATCH, *COARSE, coarse, seed=1),
        random_array(5, 5, 5, fine, coarse, seed=2),
    )


def touching():
    """Every pair of coarse and fine voxels that touch, and the tap between them."""
    for i in np.ndindex(COARSE):
        for k in np.ndindex(5, 5, 5):
            j = tuple(2 * np.array(i) + k - 2)
            if all(0 <= a < n for a, n in zip(j, FINE, strict=True)):
                yield i, j, k


def looped(fine, coarse, kernel):
    """Both convolutions and the kernel's gradient, one pair of voxels at a time."""
    fine, coarse, kernel = (np.asarray(x, np.float64) for x in (fine, coarse, kernel))
    down, up, gradient = np.zeros(coarse.shape), np.zeros(fine.shape), np.zeros(kernel.shape)
    for i, j, k in touching():
        x, y = fine[:, *j], coarse[:, *i]
        down[:, *i] += x @ kernel[k]
        up[:, *j] += y @ kernel[k].T
        gradient[k] += x.T @ y
    return down, up, gradient


def both_and_gradient(fine, coarse, kernel):
    """The public functions, and the kernel's gradient through each of them."""
    down, down_vjp = jax.vjp(downsample, fine, kernel)
    up, up_vjp = jax.vjp(upsample, coarse, kernel)
    return (down, up), down_vjp(coarse), up_vjp(fine)


def xla_forms(fine, coarse, kernel):
    return (
        convolution._downsample_xla(fine, kernel),
        convolution._upsample_xla(coarse, kernel),
        convolution._kernel_gradient_xla(fine, coarse),
    )


def cpu_forms(fine, coarse, kernel):
    return (
        convolution._downsample_cpu(fine, kernel),
        convolution._upsample_cpu(coarse, kernel),
        convolution._kernel_gradient_cpu(fine, coarse),
    )


@pytest.fixture(scope="module", params=CHANNELS, ids=str)
def case(request):
    """An example and what the loops make of it."""
    arrays = example(request.param)
    return arrays, looped(*arrays)


@pytest.fixture(scope="module")
def found(case):
    return jax.jit(both_and_gradient)(*case[0])


def assert_close(found, expected, atol=1e-3):
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(np.asarray(a, np.float64), b, atol=atol)


def test_convolutions_and_their_gradients_agree_with_loops(case, found):
    _, (down, up, gradient) = case
    values, through_down, through_up = found
    assert_close(values, (down, up))
    assert_close(through_down, (up, gradient))
    assert_close(through_up, (down, gradient))


def test_each_convolution_is_the_adjoint_of_the_other(case, found):
    (fine, coarse, _), _ = case
    down, up = found[0]
    np.testing.assert_allclose(jnp.vdot(down, coarse), jnp.vdot(fine, up), rtol=1e-4, atol=1e-2)


def test_xlas_convolutions_agree_with_loops(case):
    arrays, expected = case
    assert_close(jax.jit(xla_forms)(*arrays), expected)


def test_a_few_examples_at_a_time_give_the_same_as_all_at_once(monkeypatch):
    monkeypatch.setattr(convolution, "_examples_in_cache", lambda grids: 2)
    arrays = example(CHANNELS[-1])
    assert BATCH % 2 == 1
    assert_close(jax.jit(lambda *x: cpu_forms(*x))(*arrays), looped(*arrays))


@pytest.mark.parametrize("shape", [(32, 32, 32, 1), (8, 8, 8, 32), (4, 4, 4, 128)])
def test_the_chunks_fill_the_cache_and_no_more(shape):
    size = convolution._examples_in_cache(jnp.zeros((1, *shape)))
    gathered = 25 / 4 * np.prod(shape) * 4
    assert size * gathered <= convolution.CACHE_BYTES < (size + 1) * gathered


def test_examples_larger_than_the_cache_go_one_at_a_time():
    assert convolution._examples_in_cache(jnp.zeros((3, 32, 32, 32, 8))) == 1


def test_bfloat16_stays_close_to_float32():
    arrays = example(CHANNELS[-1])
    found = jax.jit(cpu_forms)(*(x.astype(jnp.bfloat16) for x in arrays))
    for a, b in zip(found, looped(*arrays), strict=True):
        error = np.asarray(a, np.float64) - b
        assert 0 < np.sqrt(np.mean(error**2)) < 0.02 * np.sqrt(np.mean(b**2))


def test_vmap_over_kernels_equals_a_loop():
    fine, coarse, kernel = example(CHANNELS[-1])
    kernels = jnp.stack([kernel, kernel[::-1]])
    both = lambda k: (downsample(fine, k), upsample(coarse, k))  # noqa: E731
    batched = jax.jit(jax.vmap(both))(kernels)
    for i, k in enumerate(kernels):
        assert_close([x[i] for x in batched], looped(fine, coarse, k)[:2])


def test_torch_computes_the_same_layers(case):
    torch = pytest.importorskip("torch")
    (fine, coarse, kernel), (down, up, _) = case
    channels_first = lambda x: torch.tensor(np.moveaxis(np.asarray(x), -1, 1))  # noqa: E731
    weight = torch.tensor(np.asarray(kernel).transpose(4, 3, 0, 1, 2))  # [coarse, fine, 5, 5, 5]
    conv = torch.nn.functional.conv3d(channels_first(fine), weight, stride=2, padding=2)
    transposed = torch.nn.functional.conv_transpose3d(
        channels_first(coarse), weight, stride=2, padding=2, output_padding=1
    )
    assert_close([np.moveaxis(x.numpy(), 1, -1) for x in (conv, transposed)], (down, up))
