"""Options that several commands take, and the ranges in which they make sense."""

import math
from dataclasses import dataclass
from typing import Any

from jaxshape import process
from jaxshape.cli.common import require
from jaxshape.data.config import Axis, DatasetConfig
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.model.config import TrainConfig
from jaxshape.search.config import RefineConfig


@dataclass(frozen=True, kw_only=True)
class Axes:
    """How the files of --meshes are turned."""

    up: Axis = "y"
    """Axis of the meshes that points up."""
    front: Axis = "z"
    """Axis of the meshes along which the object's front looks."""


@dataclass(frozen=True, kw_only=True)
class Machines:
    """All devices of a machine are used anyway. Several machines train together, one process on
    each, where all see the dataset and the output folder; the first writes.

    Under Slurm: srun --ntasks-per-node=1 jaxshape train --distributed --dataset data/chairs
    --output out/train

    By hand, on the first of two (the other gets --process 1): jaxshape train --coordinator
    FIRST-HOST:1234 --processes 2 --process 0 --dataset data/chairs --output out/train
    """

    distributed: bool = False
    """Join the processes that Slurm or Open MPI started together."""
    coordinator: str | None = None
    """Join processes started by hand: HOST:PORT of the first of them, the same for all."""
    processes: int | None = None
    """With --coordinator: how many there are."""
    process: int | None = None
    """With --coordinator: which of them this one is, from 0."""

    def join(self) -> None:
        """Join the others, if there are any; to be called before JAX computes."""
        count, index = self.processes, self.process
        if count is not None and index is not None:
            require(0 <= index < count, f"--process is {index} of {count}; they count from 0.")
        if self.distributed or (self.coordinator, count, index) != (None, None, None):
            process.join_processes(self.coordinator, count, index)


def checked_search(search: RefineConfig) -> RefineConfig:
    """The options of a search, once each is in its range."""
    _require_each(
        search,
        ("iterations", search.iterations >= 1, "1 or more"),
        ("population", search.population >= 3, "3 or more"),
        ("sigma0", _positive(search.sigma0), "a number above 0"),
        ("step_size", search.step_size is None or _positive(search.step_size), "a number above 0"),
        ("bound", search.bound is None or _positive(search.bound), "a number above 0"),
        ("prior_weight", 0 <= search.prior_weight < math.inf, "0 or more"),
        ("tolerance", 0 <= search.tolerance < math.inf, "0 or more"),
        ("target", search.target is None or not math.isnan(search.target), "a number"),
    )
    return search


def checked_mapping(config: MappingConfig) -> MappingConfig:
    """The options of a map, once each is in its range."""
    _require_each(
        config,
        ("keyframe_angle", _positive(config.keyframe_angle), "a number of degrees above 0"),
        ("keyframe_distance", _positive(config.keyframe_distance), "a number of metres above 0"),
        ("min_hits", config.min_hits >= 1, "1 or more"),
        ("keyframe_iterations", config.keyframe_iterations >= 1, "1 or more"),
    )
    return config


def checked_tracking(config: TrackingConfig) -> TrackingConfig:
    """The options of tracking, once each is in its range."""
    _require_each(
        config,
        ("min_inliers", 0 <= config.min_inliers <= 1, "a share from 0 to 1"),
        ("sure_inliers", 0 <= config.sure_inliers <= 1, "a share from 0 to 1"),
        ("min_overlap", 0 <= config.min_overlap <= 1, "a share from 0 to 1"),
        ("max_angle", _positive(config.max_angle), "a number of degrees above 0"),
        ("max_distance", _positive(config.max_distance), "a number of metres above 0"),
    )
    return config


def checked_dataset(config: DatasetConfig) -> DatasetConfig:
    """The options of a dataset, once each is in its range."""
    _require_each(
        config,
        ("views", config.views >= 1, "1 or more"),
        ("noisy", 0 <= config.noisy <= 1, "a share from 0 to 1"),
        ("seed", config.seed >= 0, "a number that is not negative"),
    )
    return config


def checked_training(config: TrainConfig) -> TrainConfig:
    """The options of a training run, once each is in its range."""
    sizes, inputs = config.architecture, config.inputs
    shares = ("complete", "pose_error", "missing", "segmentation")
    _require_each(
        config,
        ("steps", config.steps >= 1, "1 or more"),
        ("batch", config.batch >= 1, "1 or more"),
        ("learning_rate", _positive(config.learning_rate), "a number above 0"),
        ("occupied_weight", _positive(config.occupied_weight), "a number above 0"),
        ("code_noise", 0 <= config.code_noise < math.inf, "0 or more"),
        ("code_weight", 0 <= config.code_weight < math.inf, "0 or more"),
        ("report_every", config.report_every >= 1, "1 or more"),
        ("seed", config.seed >= 0, "a number that is not negative"),
    )
    _require_each(
        sizes,
        ("encoder", min(sizes.encoder) >= 1, "four numbers of channels from 1 up"),
        ("decoder", min(sizes.decoder) >= 1, "three numbers of channels from 1 up"),
        ("code", sizes.code >= 2, "2 or more"),
    )
    _require_each(
        inputs,
        ("max_views", inputs.max_views >= 1, "1 or more"),
        ("scale", 0 <= inputs.scale < 1, "a share from 0 to below 1"),
        *((name, 0 <= getattr(inputs, name) <= 1, "a share from 0 to 1") for name in shares),
    )
    return config


def checked_numbers(text: str, option: str) -> tuple[int, ...]:
    """Different whole numbers from 1 up, given with commas."""
    try:
        numbers = tuple(int(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    require(
        bool(numbers) and min(numbers, default=0) >= 1 and len(set(numbers)) == len(numbers),
        f"{option} is {text!r}; give different whole numbers from 1 up, with commas, as in 1,4,8.",
    )
    return numbers


def _positive(x: float) -> bool:
    return 0 < x < math.inf


def _require_each(settings: Any, *rules: tuple[str, bool, str]) -> None:
    """Refuse the first field that is out of range; a rule is its name, whether it is fine, and
    what is wanted."""
    for name, is_fine, wanted in rules:
        given = getattr(settings, name)
        given = " ".join(map(str, given)) if isinstance(given, tuple) else given
        require(is_fine, f"--{name.replace('_', '-')} is {given}; give {wanted}.")
