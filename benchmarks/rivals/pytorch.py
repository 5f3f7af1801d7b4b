"""The same auto-encoder in PyTorch, written as an expert would: the rival of the benchmarks.

Built from jaxshape's parameters, so that both compute the same function: 5x5x5 kernels, stride 2,
padding 2 in the encoder; the decoder's transposed convolutions have padding 2 and output padding 1,
but the first, on a single voxel, padding 1 and output padding 1 (4 voxels). Its output is the logit
2 (x + bias) of the paper's (tanh + 1) / 2.

`channels_last` and `autocast` are the variants worth timing; `fold` removes batch normalisation
from a decoder that is not trained. The best of them is the rival.
"""

import copy
from collections.abc import Callable, Iterator
from typing import Any, Literal

import jax
import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

LEAKY_SLOPE = 0.2
DEVICE = "cuda" if jax.default_backend() == "gpu" and torch.cuda.is_available() else "cpu"


class Encoder(nn.Module):
    """[b, x, y, z] occupancy to [b, d] codes."""

    def __init__(self, channels: tuple[int, ...] = (32, 64, 128, 256), code: int = 100):
        super().__init__()
        ends = zip((1, *channels), channels, strict=False)
        self.conv = nn.ModuleList(nn.Conv3d(i, o, 5, 2, 2, bias=False) for i, o in ends)
        self.norm = nn.ModuleList(nn.BatchNorm3d(c) for c in channels)
        self.project = nn.Linear(channels[-1], code)

    def forward(self, grid: torch.Tensor) -> torch.Tensor:
        x = grid[:, None]
        for conv, norm in zip(self.conv, self.norm, strict=True):
            x = F.leaky_relu(norm(conv(x)), LEAKY_SLOPE)
        return self.project(x.mean((2, 3, 4)))


class Decoder(nn.Module):
    """[b, d] codes to [b, x, y, z] logits."""

    def __init__(self, channels: tuple[int, ...] = (128, 64, 32), code: int = 100):
        super().__init__()
        self.first = nn.Linear(code, 64 * channels[0], bias=False)
        """The transposed convolution of one voxel, as the product it is."""
        ends = zip(channels, (*channels[1:], 1), strict=True)
        self.conv = nn.ModuleList(
            nn.ConvTranspose3d(i, o, 5, 2, 2, output_padding=1, bias=False) for i, o in ends
        )
        self.norm = nn.ModuleList(nn.BatchNorm3d(c) for c in channels)
        self.bias = nn.Parameter(torch.zeros(()))

    def forward(self, code: torch.Tensor) -> torch.Tensor:
        x = self.first(code).unflatten(1, (-1, 4, 4, 4))
        for conv, norm in zip(self.conv, self.norm, strict=True):
            x = conv(F.leaky_relu(norm(x), LEAKY_SLOPE))
        return 2.0 * (x[:, 0].float() + self.bias)


class AutoEncoder(nn.Module):
    def __init__(self, encoder: Encoder, decoder: Decoder):
        super().__init__()
        self.encoder, self.decoder = encoder, decoder

    def forward(self, grid: torch.Tensor) -> torch.Tensor:
        return self.decoder(self.encoder(grid))


def from_jaxshape(variables: Any) -> AutoEncoder:
    """The network of jaxshape's `params` and `batch_stats`, ready to evaluate."""
    params, stats = variables["params"], variables["batch_stats"]
    tensor = lambda x: torch.tensor(np.asarray(x))  # noqa: E731
    # [5, 5, 5, fine, coarse] is [coarse, fine, 5, 5, 5] to both of torch's layers.
    kernel = lambda x: tensor(np.asarray(x).transpose(4, 3, 0, 1, 2).copy())  # noqa: E731

    def norms(name: str) -> Iterator[dict[str, torch.Tensor]]:
        for i in range(sum(key.startswith("norm") for key in params[name])):
            affine, moments = params[name][f"norm{i}"], stats[name][f"norm{i}"]
            yield dict(
                weight=tensor(affine["scale"]),
                bias=tensor(affine["bias"]),
                running_mean=tensor(moments["mean"]),
                running_var=tensor(moments["var"]),
            )

    e, d = params["encoder"], params["decoder"]
    encoder = Encoder(tuple(e[f"conv{i}"].shape[-1] for i in range(4)), d["conv0"].shape[-1])
    decoder = Decoder(tuple(d[f"conv{i}"].shape[-2] for i in range(3)), d["conv0"].shape[-1])
    for i, conv in enumerate(encoder.conv):
        conv.load_state_dict({"weight": kernel(e[f"conv{i}"])})
    encoder.project.load_state_dict(
        {"weight": tensor(e["project"]["kernel"]).T, "bias": tensor(e["project"]["bias"])}
    )
    first = kernel(d["conv0"])[:, :, 1:, 1:, 1:]  # the taps that land in the grid
    decoder.first.load_state_dict({"weight": first.flatten(1).T})
    for i, conv in enumerate(decoder.conv):
        conv.load_state_dict({"weight": kernel(d[f"conv{i + 1}"])})
    for module, name in ((encoder, "encoder"), (decoder, "decoder")):
        for norm, values in zip(module.norm, norms(name), strict=True):
            norm.eps, norm.momentum = 1e-5, 0.1  # Flax's momentum of 0.9
            norm.load_state_dict(values, strict=False)
    decoder.bias.data = tensor(d["bias"])
    return AutoEncoder(encoder, decoder).eval()


def fold(decoder: Decoder) -> Decoder:
    """The decoder with its batch normalisations multiplied into the kernels before them."""
    decoder = copy.deepcopy(decoder).eval()
    scales = [n.weight / torch.sqrt(n.running_var + n.eps) for n in decoder.norm]
    biases = [n.bias - n.running_mean * s for n, s in zip(decoder.norm, scales, strict=True)]
    with torch.no_grad():
        repeated = scales[0].repeat_interleave(64)
        decoder.first.weight *= repeated[:, None]
        decoder.first.bias = nn.Parameter(biases[0].repeat_interleave(64))
        for conv, scale, bias in zip(decoder.conv, scales[1:], biases[1:], strict=False):
            conv.weight *= scale[None, :, None, None, None]
            conv.bias = nn.Parameter(bias.clone())
    decoder.norm = nn.ModuleList(nn.Identity() for _ in decoder.norm)
    return decoder


def cross_entropy(
    logits: torch.Tensor, occupied: torch.Tensor, empty: torch.Tensor
) -> torch.Tensor:
    """Eq. 7 of every candidate, from the two weights of `jaxshape.search.objective.Target`."""
    total = (occupied + empty) * F.softplus(logits) - occupied * logits
    return total.mean((-3, -2, -1))


def scorer(
    decoder: Decoder,
    occupied: np.ndarray,
    empty: np.ndarray,
    *,
    channels_last: bool = False,
    bfloat16: Literal["no", "autocast", "cast"] = "no",
    at_a_time: int | None = None,
) -> Callable[[np.ndarray], np.ndarray]:
    """`[..., d]` codes to objectives (decode, then Eq. 7), `at_a_time` together or all at once.

    The targets of one object, or of as many as the codes' leading axis has.
    """
    decoder = laid_out(fold(decoder), channels_last)
    if bfloat16 == "cast":
        decoder = decoder.to(torch.bfloat16)
    dtype = next(decoder.parameters()).dtype
    targets = [torch.tensor(np.array(x), device=DEVICE) for x in (occupied, empty)]

    @torch.inference_mode()
    def score(codes: np.ndarray) -> np.ndarray:
        flat = torch.as_tensor(codes, device=DEVICE, dtype=dtype).flatten(0, -2)
        n = codes.shape[-2]
        each = [
            x.expand(n, *x.shape) if x.ndim == 3 else x.repeat_interleave(n, 0) for x in targets
        ]
        size = at_a_time or len(flat)
        chunks = zip(flat.split(size), *(x.split(size) for x in each), strict=True)
        with torch.autocast(DEVICE, torch.bfloat16, enabled=bfloat16 == "autocast"):
            losses = [cross_entropy(decoder(chunk), *target) for chunk, *target in chunks]
        return torch.cat(losses).unflatten(0, codes.shape[:-1]).cpu().numpy()

    return score


def trainer(
    network: AutoEncoder,
    *,
    channels_last: bool = False,
    bfloat16: bool = False,
    learning_rate: float = 1e-3,
) -> Callable[[np.ndarray, np.ndarray], float]:
    """One step of Adam on a batch of measured and complete grids; gives the loss."""
    network = laid_out(network, channels_last).train()
    adam = adam_for(network, learning_rate)

    def step(measured: np.ndarray, surface: np.ndarray) -> torch.Tensor:
        grid, truth = (torch.as_tensor(x, device=DEVICE).float() for x in (measured, surface))
        with torch.autocast(DEVICE, torch.bfloat16, enabled=bfloat16):
            logits = network(grid)
            loss = F.binary_cross_entropy_with_logits(logits.float(), truth)
        return descend(adam, loss, logits, truth)

    return step


def laid_out(network: nn.Module, channels_last: bool) -> Any:
    """A copy of a network on the device, in either layout."""
    network = copy.deepcopy(network).to(DEVICE)
    return network.to(memory_format=torch.channels_last_3d) if channels_last else network


def adam_for(network: nn.Module, learning_rate: float) -> torch.optim.Adam:
    """Adam with the settings of jaxshape."""
    return torch.optim.Adam(network.parameters(), learning_rate, (0.9, 0.999), fused=True)


def descend(
    adam: torch.optim.Adam, loss: torch.Tensor, logits: torch.Tensor, truth: torch.Tensor
) -> float:
    """Move down the gradient of the loss; gives the loss."""
    adam.zero_grad()
    loss.backward()
    adam.step()
    with torch.no_grad():  # the mean IoU that jaxshape's step reports too
        done, true, axes = logits > 0, truth > 0, (1, 2, 3)
        (done & true).sum(axes).div((done | true).sum(axes)).mean()
    return loss.item()


def product(a: np.ndarray, b: np.ndarray, precision: str) -> Callable[[], torch.Tensor]:
    """The product of two matrices."""
    dtype = getattr(torch, precision)
    x, y = (torch.tensor(matrix, dtype=dtype, device=DEVICE) for matrix in (a, b))

    def multiply():
        product = x @ y
        if DEVICE == "cuda":
            torch.cuda.synchronize()
        return product

    return multiply
