"""The conditional network in PyTorch, written as an expert would: the rival of `completion`.

Built from jaxshape's parameters, so that both compute the same function. Patches of 2^3 voxels are
merged by convolutions of stride 2 and split by transposed ones; `channels_last` and `bfloat16` are
the variants worth timing. It starts from the four channels of evidence that the network sees.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from benchmarks.rivals.pytorch import DEVICE, adam_for, cross_entropy, descend, laid_out

Bfloat16 = Literal["no", "autocast", "cast"]


class Skips(NamedTuple):
    """Features of the measurement, channels first."""

    fine: torch.Tensor
    middle: torch.Tensor
    coarse: torch.Tensor


class Block(nn.Module):
    """x + W act(K * act(norm(x)) + V code)."""

    def __init__(self, channels: int, code: int = 0):
        super().__init__()
        self.scale = nn.Parameter(torch.ones(1, channels, 1, 1, 1))
        self.conv = nn.Conv3d(channels, channels, 3, padding=1, bias=False)
        self.mix = nn.Conv3d(channels, channels, 1)
        if code:
            self.code = nn.Linear(code, channels)

    def forward(self, x: torch.Tensor, code: torch.Tensor | None = None) -> torch.Tensor:
        wide = x.float()
        y = (wide * torch.rsqrt(wide.square().mean(1, True) + 1e-6) * self.scale).to(x.dtype)
        y = self.conv(F.silu(y))
        if code is not None:
            y = y + self.code(code)[:, :, None, None, None]
        return x + self.mix(F.silu(y))


class Split(nn.Module):
    """One voxel to 2^3 voxels, each with a bias of its own."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.spread = nn.ConvTranspose3d(inputs, outputs, 2, 2, bias=False)
        self.bias = nn.Parameter(torch.zeros(1, outputs, 2, 2, 2))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.spread(x) + self.bias.repeat(1, 1, *x.shape[2:]).to(x.dtype)


class Measured(nn.Module):
    """Evidence `[b 4 x y z]` to features."""

    def __init__(self, channels: tuple[int, int, int], depth: int):
        super().__init__()
        fine, middle, coarse = channels
        self.stem, self.fine = nn.Conv3d(4, fine, 2, 2), Block(fine)
        self.down1 = nn.Conv3d(fine, middle, 2, 2)
        self.middle = nn.ModuleList(Block(middle) for _ in range(depth))
        self.down2 = nn.Conv3d(middle, coarse, 2, 2)
        self.coarse = nn.ModuleList(Block(coarse) for _ in range(depth))

    def forward(self, evidence: torch.Tensor) -> Skips:
        fine = self.fine(self.stem(evidence))
        middle = self.down1(fine)
        for block in self.middle:
            middle = block(middle)
        coarse = self.down2(middle)
        for block in self.coarse:
            coarse = block(coarse)
        return Skips(fine, middle, coarse)


class Decoder(nn.Module):
    """Features and codes to logits `[b x y z]`; features of one object serve all of its codes."""

    def __init__(self, channels: tuple[int, int, int], depth: int, code: int, cells: int):
        super().__init__()
        fine, middle, coarse = channels
        self.cells = round(cells ** (1 / 3))
        self.code, self.coarse = nn.Linear(code, cells * coarse), Block(coarse, code)
        self.up1 = Split(coarse, middle)
        self.middle = nn.ModuleList(Block(middle, code) for _ in range(depth))
        self.up2, self.fine = Split(middle, fine), Block(fine, code)
        self.logits = Split(fine, 1)

    def forward(self, found: Skips, code: torch.Tensor) -> torch.Tensor:
        cells = self.code(code).unflatten(1, (-1, *[self.cells] * 3))
        x = self.coarse(found.coarse + cells, code)
        x = found.middle + self.up1(x)
        for block in self.middle:
            x = block(x, code)
        x = self.fine(found.fine + self.up2(x), code)
        return self.logits(x)[:, 0].float()


class Posterior(nn.Module):
    """Evidence and the complete surface `[b 5 x y z]` to means and log-variances of codes."""

    def __init__(self, channels: tuple[int, int, int], code: int, cells: int):
        super().__init__()
        fine, middle, coarse = (max(8, c // 2) for c in channels)
        self.stem, self.down1 = nn.Conv3d(5, fine, 2, 2), nn.Conv3d(fine, middle, 2, 2)
        self.middle = Block(middle)
        self.down2, self.coarse = nn.Conv3d(middle, coarse, 2, 2), Block(coarse)
        self.squeeze, self.code = nn.Conv3d(coarse, fine, 1), nn.Linear(cells * fine, 2 * code)

    def forward(self, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        x = self.middle(self.down1(F.silu(self.stem(seen))))
        x = F.silu(self.squeeze(self.coarse(self.down2(x))))
        mean, log_variance = self.code(x.flatten(1)).float().chunk(2, dim=1)
        return mean, log_variance.clamp(-10.0, 3.0)


class Completion(nn.Module):
    """The whole network; `forward` is one example of training."""

    def __init__(self, channels: tuple[int, int, int], depth: int, code: int, cells: int):
        super().__init__()
        self.measured = Measured(channels, depth)
        self.decoder = Decoder(channels, depth, code, cells)
        self.posterior = Posterior(channels, code, cells)

    def forward(
        self, evidence: torch.Tensor, surface: torch.Tensor, noise: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Logits, and the divergence in nats; every second example decodes the first code, 0."""
        mean, log_variance = self.posterior(torch.cat([evidence, surface[:, None]], 1))
        searched = (torch.arange(len(mean), device=mean.device) % 2 == 1)[:, None]
        code = torch.where(searched, mean + torch.exp(log_variance / 2) * noise, 0.0)
        logits = self.decoder(self.measured(evidence), code)
        nats = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance)
        return logits, torch.where(searched, nats, 0.0).sum()


def from_jaxshape(params: Any) -> Completion:
    """The network of jaxshape's parameters, ready to evaluate."""
    measured, decoder, posterior = (params[x] for x in ("measured", "decoder", "posterior"))
    channels = tuple(measured[x]["kernel"].shape[-1] for x in ("stem", "down1", "down2"))
    code, values = decoder["code"]["kernel"].shape
    cells = values // channels[-1]
    network = Completion(channels, len(measured["middle"]), code, cells)  # type: ignore[arg-type]
    side = round(cells ** (1 / 3))
    array = lambda x: np.asarray(x, np.float32)  # noqa: E731
    out: dict[str, np.ndarray] = {}

    def linear(name, layer):
        out[f"{name}.weight"], out[f"{name}.bias"] = array(layer["kernel"]).T, array(layer["bias"])

    def merge(name, layer, patch=2):  # [(px, py, pz, in), out] to [out, in, px, py, pz]
        kernel = array(layer["kernel"])
        kernel = kernel.reshape(*[patch] * 3, -1, kernel.shape[-1])
        out[f"{name}.weight"] = kernel.transpose(4, 3, 0, 1, 2)
        out[f"{name}.bias"] = array(layer["bias"])

    def split(name, layer):  # [in, (px, py, pz, out)] to [in, out, px, py, pz]
        kernel, bias = array(layer["kernel"]), array(layer["bias"])
        kernel = kernel.reshape(len(kernel), 2, 2, 2, -1)
        out[f"{name}.spread.weight"] = kernel.transpose(0, 4, 1, 2, 3)
        out[f"{name}.bias"] = bias.reshape(1, 2, 2, 2, -1).transpose(0, 4, 1, 2, 3)

    def block(name, layer):
        out[f"{name}.scale"] = array(layer["scale"])[None, :, None, None, None]
        out[f"{name}.conv.weight"] = array(layer["kernel"]).transpose(4, 3, 0, 1, 2)
        merge(f"{name}.mix", layer["mix"], patch=1)
        if "code" in layer:
            linear(f"{name}.code", layer["code"])

    for part, names in {"measured": ("stem", "down1", "down2"),
                        "posterior": ("stem", "down1", "down2")}.items():  # fmt: skip
        for name in names:
            merge(f"{part}.{name}", params[part][name])
    for part, names in {"measured": ("fine",), "decoder": ("coarse", "fine"),
                        "posterior": ("middle", "coarse")}.items():  # fmt: skip
        for name in names:
            block(f"{part}.{name}", params[part][name])
    for part, names in {"measured": ("middle", "coarse"), "decoder": ("middle",)}.items():
        for name in names:
            for i, layer in params[part][name].items():
                block(f"{part}.{name}.{i}", layer)
    for name in ("up1", "up2", "logits"):
        split(f"decoder.{name}", decoder[name])
    merge("posterior.squeeze", posterior["squeeze"], patch=1)
    # Voxels of the coarse grid come before channels in jaxshape, and after them here.
    grid = (side, side, side)
    first = {k: array(x).reshape(-1, *grid, channels[-1]) for k, x in decoder["code"].items()}
    first = {k: x.transpose(0, 4, 1, 2, 3).reshape(len(x), -1) for k, x in first.items()}
    out["decoder.code.weight"], out["decoder.code.bias"] = first["kernel"].T, first["bias"][0]
    last = array(posterior["code"]["kernel"])
    last = last.reshape(*grid, -1, last.shape[-1]).transpose(3, 0, 1, 2, 4)
    linear("posterior.code", {"kernel": last.reshape(-1, last.shape[-1]),
                              "bias": posterior["code"]["bias"]})  # fmt: skip
    network.load_state_dict({name: torch.tensor(x.copy()) for name, x in out.items()})
    return network.eval()


def completer(
    network: Completion, *, channels_last: bool = False, bfloat16: bool = False
) -> Callable[[np.ndarray], np.ndarray]:
    """Evidence of objects `[b 4 x y z]` to the logits of their first codes."""
    network = laid_out(network, channels_last)
    code = network.decoder.code.in_features

    @torch.inference_mode()
    def complete(evidence: np.ndarray) -> np.ndarray:
        seen = torch.as_tensor(evidence, device=DEVICE)
        with torch.autocast(DEVICE, torch.bfloat16, enabled=bfloat16):
            sides = _sides(network.measured, seen)
            logits = _decoded(network.decoder, sides, torch.zeros(len(seen), code, device=DEVICE))
        return logits.cpu().numpy()

    return complete


def scorer(
    network: Completion,
    evidence: np.ndarray,
    occupied: np.ndarray,
    empty: np.ndarray,
    *,
    channels_last: bool = False,
    bfloat16: Bfloat16 = "no",
    at_a_time: int | None = None,
) -> Callable[[np.ndarray], np.ndarray]:
    """Codes `[n d]` of one object to objectives (decode, then Eq. 7), some together or all."""
    decoder = laid_out(network.decoder, channels_last)
    with torch.inference_mode():
        sides = _sides(network.measured.to(DEVICE), torch.tensor(evidence, device=DEVICE)[None])
    dtype = torch.bfloat16 if bfloat16 == "cast" else torch.float32
    decoder, sides = decoder.to(dtype), [Skips(*(x.to(dtype) for x in side)) for side in sides]
    target = [torch.tensor(np.array(x), device=DEVICE) for x in (occupied, empty)]

    @torch.inference_mode()
    def score(codes: np.ndarray) -> np.ndarray:
        chunks = torch.as_tensor(codes, device=DEVICE, dtype=dtype).split(at_a_time or len(codes))
        with torch.autocast(DEVICE, torch.bfloat16, enabled=bfloat16 == "autocast"):
            losses = [cross_entropy(_decoded(decoder, sides, x), *target) for x in chunks]
        return torch.cat(losses).cpu().numpy()

    return score


def _sides(measured: Measured, evidence: torch.Tensor) -> list[Skips]:
    """Features of each object and of its mirror image, from one batch."""
    other = evidence[:, [2, 3, 0, 1]]
    both = measured(torch.cat([evidence, other]))
    return [Skips(*(x.chunk(2)[side] for x in both)) for side in (0, 1)]


def _decoded(decoder: Decoder, sides: list[Skips], code: torch.Tensor) -> torch.Tensor:
    """Mean logits of the predictions for the object and for its mirror image."""
    here, there = (decoder(side, code) for side in sides)
    return (here + there.flip(-3)) / 2


def trainer(
    network: Completion,
    *,
    channels_last: bool = False,
    bfloat16: bool = False,
    learning_rate: float = 1e-3,
) -> Callable[..., float]:
    """One step of Adam on the evidence bound; gives the loss."""
    network = laid_out(network, channels_last).train()
    adam = adam_for(network, learning_rate)

    def step(evidence, surface, noise) -> float:
        tensors = [torch.as_tensor(x, device=DEVICE) for x in (evidence, surface, noise)]
        seen, truth, normal = (x.float() for x in tensors)
        with torch.autocast(DEVICE, torch.bfloat16, enabled=bfloat16):
            logits, nats = network(seen, truth, normal)
            loss = F.binary_cross_entropy_with_logits(logits.float(), truth)
            loss = loss + nats / truth.numel()
        return descend(adam, loss, logits, truth)

    return step
