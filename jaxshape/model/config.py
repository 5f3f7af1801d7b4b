"""Sizes of networks and settings of their training.

Nothing here imports JAX, so that the command line starts quickly.
"""

from dataclasses import dataclass, replace
from typing import Literal, get_args

from jaxshape import checks, limits
from jaxshape.data.config import InputConfig

Optimizer = Literal["muon", "adam"]
Schedule = Literal["cosine", "constant"]
Precision = Literal["float32", "bfloat16"]
"""Precision of a decoder's matrix products."""


@dataclass(frozen=True)
class Architecture:
    """Sizes of the auto-encoder; the figure of the paper that gives them is not available.

    The number of layers decides the resolution of its grids: 4 strided convolutions for 32^3, one
    more for 64^3, one less for 16^3.

    Attributes:
        encoder: Channels after each strided convolution, each 1 or more.
        decoder: Channels after each transposed convolution except the last, which has one channel:
            one entry fewer than `encoder`, each 1 or more.
        code: Dimension of a code, 2 or more (paper: 100).
        occlusion: Give the encoder the occlusion mask M beside F, both soft. The paper's encoder
            sees F alone, binary, and cannot tell free voxels from unknown ones.

    Raises:
        ValueError: The layers of encoder and decoder do not match, or a size is outside its range.
    """

    encoder: tuple[int, ...] = (32, 64, 128, 256)
    decoder: tuple[int, ...] = (128, 64, 32)
    code: int = 100
    occlusion: bool = False

    def __post_init__(self) -> None:
        checks.one_of("occlusion", self.occlusion, (True, False))
        for name in ("encoder", "decoder"):
            _check_channels(name, getattr(self, name))
        checks.whole(
            "code", self.code, 2, limits.CODE, "the covariance of codes has the square of that"
        )
        if len(self.encoder) != len(self.decoder) + 1:
            raise ValueError(
                f"The encoder has {len(self.encoder)} layers and the decoder "
                f"{len(self.decoder)} numbers of channels; give the encoder one more than the "
                "decoder, such as 32 64 128 256 and 128 64 32 for grids of 32^3 voxels."
            )

    @property
    def resolution(self) -> int:
        """Voxels along each axis of the grids."""
        return 4 * 2 ** len(self.decoder)


@dataclass(frozen=True)
class Completion:
    """Sizes of the network that is conditioned on the measurement (`model/completion`).

    Attributes:
        channels: Channels at a half, a quarter and an eighth of the resolution, each 1 or more.
        depth: Blocks at a quarter and an eighth of the resolution on the way down, 1 or more.
        code: Dimension of a code, 2 or more.
        resolution: Voxels along each axis of the grids, a multiple of 8.

    Raises:
        ValueError: A size is outside its range.
    """

    channels: tuple[int, int, int] = (32, 96, 128)
    depth: int = 2
    code: int = 100
    resolution: int = 32

    def __post_init__(self) -> None:
        _check_channels("channels", self.channels)
        checks.whole("depth", self.depth, 1, limits.CHANNELS)
        checks.whole(
            "code", self.code, 2, limits.CODE, "the covariance of codes has the square of that"
        )
        if not 8 <= self.resolution <= limits.RESOLUTION or self.resolution % 8:
            checks.refuse(
                "resolution", self.resolution, f"a multiple of 8, up to {limits.RESOLUTION}"
            )


def _check_channels(name: str, channels: tuple[int, ...]) -> None:
    if not 1 <= min(channels, default=0) <= max(channels, default=0) <= limits.CHANNELS:
        checks.refuse(name, channels, f"numbers of channels, 1 to {limits.CHANNELS} each")


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training run, besides its dataset and the weights it starts from.

    The defaults are the preset `default`.

    Attributes:
        architecture: Sizes of the network. Their class decides its kind: the conditional network,
            or the paper's auto-encoder.
        inputs: Settings for drawing training pairs from the dataset.
        steps: Total number of batches, 1 or more.
        batch: Pairs in a batch, over all devices, 1 or more.
        optimizer: Adam (paper), or Muon, which orthogonalises the steps of the kernels and needs a
            third of the samples.
        learning_rate: Peak of the optimiser's step size, above 0 (paper: 1e-4, for Adam).
        schedule: Whether the step size warms up and decays to zero along a cosine, or stays
            constant (paper).
        average: Decay of the running average of the parameters that becomes the finished weights, 0
            to below 1; 0 for the parameters of the last step.
        occupied_weight: Weight of occupied voxels in the loss, above 0 (paper: 1). At 1.5 a voxel
            counts as occupied from a probability of 0.4 on; for uncertain shapes this threshold
            gives a better IoU than 0.5.
        occluded_weight: Weight of occluded voxels in the loss, above 0 (paper: 1).
        code_noise: Standard deviation of noise added to the codes of an auto-encoder, 0 or more.
        code_weight: Weight of the code penalty, 0 or more. For a conditional network the penalty is
            the KL divergence of the codes. For an auto-encoder it is half the squared length of the
            codes, in nats; with noise of 1 this is the divergence of a posterior of variance 1.
        posterior_share: Share of each batch for which the conditional network decodes a code of the
            posterior, from 0 to 1; the others decode its first code. At 0 codes carry no
            information.
        bfloat16: Compute convolutions in bfloat16, which is faster, above all on processors with
            matrix units for it. Parameters, statistics and the optimiser stay in float32.
        validation: Number of the dataset's last objects that are kept out of training and completed
            for each report, 0 or more; at most a tenth of the dataset.
        report_every: Steps between checkpoints and lines of metrics, 1 or more; a killed run goes
            on from the last checkpoint.
        seed: Seed of the initial weights and of the batches, 0 or more.

    Raises:
        ValueError: A setting is outside its range.
    """

    architecture: Completion | Architecture = Completion()
    inputs: InputConfig = InputConfig()
    steps: int = 10_000
    batch: int = 32
    optimizer: Optimizer = "muon"
    learning_rate: float = 4e-3
    schedule: Schedule = "cosine"
    average: float = 0.998
    occupied_weight: float = 1.5
    occluded_weight: float = 2.0
    code_noise: float = 0.0
    code_weight: float = 1.0
    posterior_share: float = 0.5
    bfloat16: bool = False
    validation: int = 128
    report_every: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        checks.one_of("optimizer", self.optimizer, get_args(Optimizer))
        checks.one_of("schedule", self.schedule, get_args(Schedule))
        for name in ("steps", "report_every"):
            checks.whole(name, getattr(self, name), 1, limits.STEPS)
        checks.whole("batch", self.batch, 1, limits.BATCH, "it is in memory as a whole")
        checks.within("average", self.average, 0, 1)
        checks.within("posterior_share", self.posterior_share, 0, 1)
        checks.whole("validation", self.validation, 0)
        for name in ("learning_rate", "occupied_weight", "occluded_weight"):
            checks.positive(name, getattr(self, name))
        for name in ("code_noise", "code_weight"):
            checks.at_least(name, getattr(self, name), 0)
        checks.seed("seed", self.seed)


_AUTOENCODER = TrainConfig(Architecture(), average=0.0, occluded_weight=1.0, code_weight=0.0)

PRESETS = {
    "default": TrainConfig(),
    "autoencoder": _AUTOENCODER,
    # Single clean views (the dataset of that name), the plain loss, a constant step. The paper does
    # not give the length; this is twenty passes over its 69,444 pairs, 18 views of 3,858 chairs.
    "paper": replace(
        _AUTOENCODER,
        architecture=Architecture(decoder=(256, 128, 64)),
        inputs=InputConfig(complete=0.0, mirror=False, warp=0.0),
        steps=43_402,
        optimizer="adam",
        learning_rate=1e-4,
        schedule="constant",
        occupied_weight=1.0,
        validation=0,
    ),
}
"""Settings of training runs by name: our best, the best with the paper's network, and those of the
paper (section 2.3)."""
