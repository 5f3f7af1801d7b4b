"""Options that several commands share, with checks of their ranges."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any, Literal

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructTypeInfo

from jaxshape import process
from jaxshape.checks import BadSetting
from jaxshape.cli.common import require
from jaxshape.data.camera_config import CameraConfig
from jaxshape.data.config import Axis, CameraName, UnitName, check_axes
from jaxshape.geometry.config import FusionName

AxesName = Literal["given", "auto"]


@dataclass(frozen=True, kw_only=True)
class Axes:
    """Orientation and unit of the files of --meshes."""

    up: Axis = "y"
    """Axis of the meshes that points up."""
    front: Axis = "z"
    """Axis of the meshes towards which the object faces; perpendicular to --up."""
    axes: AxesName = "given"
    """`given` uses --up and --front for all meshes, and warns if they seem wrong; `auto` turns each
    mesh upright and to the front, if the weights for chairs know its kind."""
    unit: UnitName = "m"
    """Unit of the meshes: metres, centimetres, millimetres or inches."""

    def __post_init__(self) -> None:
        check_axes(self.up, self.front)


@dataclass(frozen=True, kw_only=True)
class Seen:
    """The depth camera, and the fusion of its frames."""

    camera: CameraName = "kinect"
    """Depth camera: the first Kinect (640 x 480 pixels), an Intel RealSense, the LiDAR of an iPhone
    (256 x 192), or the paper's square images of 96 pixels."""
    noise: tyro.conf.FlagCreatePairsOff[bool] = False
    """Give depth images the faults of the camera's sensor; the default for all cameras except the
    paper's."""
    no_noise: tyro.conf.FlagCreatePairsOff[bool] = False
    """Leave these faults out; the default for the paper's camera."""
    fusion: FusionName | None = None
    """Method that turns frames into F and M: `distance` averages signed distances on a fine grid,
    `points` counts points in voxels (paper). None selects points for the paper's camera without
    noise, and distances otherwise."""

    def config(self) -> CameraConfig:
        """The settings, checked."""
        require(not (self.noise and self.no_noise), "Give --noise or --no-noise, not both.")
        noise = self.noise or (False if self.no_noise else None)
        return CameraConfig(camera=self.camera, noise=noise, fusion=self.fusion)


@dataclass(frozen=True, kw_only=True)
class Machines:
    """All devices of a machine are always used. Several machines can work together, with one
    process on each, if all can access the same files.

    Under Slurm: srun --ntasks-per-node=1 jaxshape COMMAND --distributed ...

    By hand, on the first of two (the other gets --process 1): jaxshape COMMAND --coordinator
    FIRST-HOST:1234 --processes 2 --process 0 ...
    """

    distributed: bool = False
    """Join the other processes that Slurm or Open MPI started with this one."""
    coordinator: str | None = None
    """Join processes started by hand: HOST:PORT of the first process, the same in all processes."""
    processes: int | None = None
    """With --coordinator: number of processes."""
    process: int | None = None
    """With --coordinator: number of this process, from 0."""

    @property
    def asked(self) -> bool:
        """Whether several processes were asked for."""
        given = (self.coordinator, self.processes, self.process)
        return self.distributed or given != (None, None, None)

    def join(self, **how: Any) -> None:
        """Join the other processes, if there are any; to be called before JAX computes.

        `how` are further arguments of `join_processes`.
        """
        count, index = self.processes, self.process
        if count is not None and index is not None:
            require(0 <= index < count, f"--process is {index} of {count}; they count from 0.")
        if self.asked:
            process.join_processes(self.coordinator, count, index, **how)


class RefusedSetting(Exception):
    """Settings refused the values of the parser, in one sentence.

    It is not a `ValueError`, because the parser would turn that into a page of its own.
    """


def reworded(problem: ValueError) -> str:
    """The message of a refused setting, with the name of the option instead of the field."""
    if not isinstance(problem, BadSetting):
        return str(problem)
    value = problem.value
    given = " ".join(map(str, value)) if isinstance(value, tuple) else value
    return f"--{problem.name.replace('_', '-')} is {given}; give {problem.wanted}."


def refusing() -> ConstructorRegistry:
    """Rules for the parser, which turn refusals of settings into `RefusedSetting`."""
    registry, asked = ConstructorRegistry(), []

    @registry.struct_rule
    def rule(info: StructTypeInfo) -> Any:
        if asked or not hasattr(info.type, "__post_init__"):
            return None
        asked.append(info)  # so that the parser's own rules apply, not this one again
        try:
            spec = ConstructorRegistry.get_struct_spec(info)
        finally:
            asked.pop()
        if not isinstance(spec, StructConstructorSpec):
            return spec
        return replace(spec, instantiate=_refusing(spec.instantiate))

    return registry


def _refusing(build: Callable[..., Any]) -> Callable[..., Any]:
    """A constructor that raises `RefusedSetting` in place of `ValueError`."""

    @wraps(build)
    def built(*values: Any, **fields: Any) -> Any:
        try:
            return build(*values, **fields)
        except ValueError as problem:
            raise RefusedSetting(reworded(problem)) from problem

    return built


def checked_numbers(text: str, option: str) -> tuple[int, ...]:
    """Parse distinct whole numbers, 1 or more, separated by commas."""
    try:
        numbers = tuple(int(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    require(
        bool(numbers) and min(numbers, default=0) >= 1 and len(set(numbers)) == len(numbers),
        f"{option} is {text!r}; give different whole numbers from 1 up, with commas, as in 1,4,8.",
    )
    return numbers
