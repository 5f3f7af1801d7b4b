import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.model import convolution
from jaxshape.model.convolution import downsample, upsample

BATCH = 5

# Fine and coarse channels, and a coarse grid with no two axes alike, for each form on CPU: one
# fine channel, few voxels, and enough for tiles (which do not fill the second axis).
GATHERED, TILED = (3, 2, (2, 3, 1)), (2, 3, (8, 9, 2))
CASES = [(1, 3, (2, 3, 1)), GATHERED, TILED]


def random_array(*shape, seed=0):
    return jnp.float32(np.random.default_rng(seed).normal(size=shape))


def example(case):
    fine, coarse, size = case
    return (
        random_array(BATCH, *(2 * n for n in size), fine),
        random_array(BATCH, *size, coarse, seed=1),
        random_array(5, 5, 5, fine, coarse, seed=2),
    )


def touching(size):
    """Every pair of coarse and fine voxels that touch, and the tap between them."""
    for i in np.ndindex(size):
        for k in np.ndindex(5, 5, 5):
            j = tuple(2 * np.array(i) + k - 2)
            if all(0 <= a < 2 * n for a, n in zip(j, size, strict=True)):
                yield i, j, k


def looped(fine, coarse, kernel):
    """Both convolutions and the kernel's gradient, one pair of voxels at a time."""
    fine, coarse, kernel = (np.asarray(x, np.float64) for x in (fine, coarse, kernel))
    down, up, gradient = np.zeros(coarse.shape), np.zeros(fine.shape), np.zeros(kernel.shape)
    for i, j, k in touching(coarse.shape[1:4]):
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


@pytest.fixture(scope="module", params=CASES, ids=str)
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


@pytest.mark.parametrize("case", [GATHERED, TILED], ids=str)
def test_a_few_examples_at_a_time_give_the_same_as_all_at_once(monkeypatch, case):
    monkeypatch.setattr(convolution, "_in_cache", lambda values: 2)
    arrays = example(case)
    assert BATCH % 2 == 1
    assert_close(jax.jit(lambda *x: cpu_forms(*x))(*arrays), looped(*arrays))


@pytest.mark.parametrize("values", [1, 1000, 10**5])
def test_the_chunks_fill_the_cache_and_no_more(values):
    size = convolution._in_cache(values)
    assert size * values * 4 <= convolution.CACHE_BYTES < (size + 1) * values * 4


def test_examples_larger_than_the_cache_go_one_at_a_time():
    assert convolution._in_cache(convolution.CACHE_BYTES) == 1


@pytest.mark.parametrize("case", [GATHERED, TILED], ids=str)
def test_bfloat16_stays_close_to_float32(case):
    arrays = example(case)
    found = jax.jit(cpu_forms)(*(x.astype(jnp.bfloat16) for x in arrays))
    for a, b in zip(found, looped(*arrays), strict=True):
        error = np.asarray(a, np.float64) - b
        assert 0 < np.sqrt(np.mean(error**2)) < 0.02 * np.sqrt(np.mean(b**2))


@pytest.mark.parametrize("case", [GATHERED, TILED], ids=str)
def test_vmap_over_kernels_equals_a_loop(case):
    fine, coarse, kernel = example(case)
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
