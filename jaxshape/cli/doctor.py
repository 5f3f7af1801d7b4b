"""`jaxshape doctor`: versions, devices and caches of this machine, and reasons for slowness."""

import json
import os
import platform
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

PACKAGES = (
    "jaxshape", "jax", "jaxlib", "flax", "optax", "evosax", "numpy", "scipy", "trimesh", "embreex",
    "scikit-image", "pillow", "viser", "OpenEXR",
)  # fmt: skip
"""Packages whose versions are printed; the last two and embreex are optional."""


@dataclass(frozen=True)
class Doctor:
    """Print the versions, devices, caches and weights that jaxshape finds, and reasons for
    slowness.

    Examples: jaxshape doctor

    jaxshape doctor --json, for a bug report
    """

    json: bool = False
    """Print JSON instead of a table."""

    def run(self) -> None:
        found = findings()
        if self.json:
            print(json.dumps(found, indent=1))
            return
        table = Table(show_header=False, box=None)
        for name, value in found.items():
            if name != "advice":
                table.add_row(name, escape(_text(value)))
        out = Console()
        out.print(table)
        for sentence in found["advice"]:
            out.print(f"[yellow]slow[/] {escape(sentence)}", soft_wrap=True)


def findings() -> dict[str, Any]:
    """Everything that `jaxshape doctor` prints, in types of JSON."""
    import jax

    from jaxshape.model.weights import PACKAGED, load_prior
    from jaxshape.process import processor

    devices = jax.devices()
    return {
        "python": f"{platform.python_version()} on {platform.system()} {platform.machine()}",
        "packages": {name: _version(name) for name in PACKAGES},
        "devices": [f"{one.platform}: {one.device_kind}" for one in devices],
        "processor": processor().name,
        "cores": os.cpu_count(),
        "matrix units": sorted(f for f in processor().features if f.startswith("amx")),
        "compiled programs": _cache(os.environ.get("JAX_COMPILATION_CACHE_DIR")),
        "weights": {name: load_prior(name).model.kind for name in PACKAGED},
        "advice": list(advice(devices[0].platform)),
    }


def advice(device: str) -> Iterator[str]:
    """Reasons for slowness on this machine, with remedies."""
    from jaxshape.process import processor

    features = processor().features
    if device == "cpu":
        if features and "amx_bf16" not in features:
            yield "The processor has no matrix units for bfloat16: leave --bfloat16 out."
        if (os.cpu_count() or 1) < 4:
            yield "Training will be slow on so few CPU cores; a GPU is used if JAX finds one."
        if which("nvidia-smi") or which("rocm-smi"):
            yield "There is a GPU, and JAX does not see it: pip install 'jaxshape[cuda]'."
    if find_spec("embreex") is None:
        yield (
            "embreex is not installed: images of virtual cameras and pictures of meshes take three "
            "to five times as long."
        )
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        yield "No folder for compiled programs can be written: every run compiles again."


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _cache(folder: str | None) -> str | None:
    """The folder of compiled programs and its size."""
    if folder is None or not Path(folder).is_dir():
        return None
    sizes = [entry.stat().st_size for entry in Path(folder).iterdir() if entry.is_file()]
    return f"{folder}, {len(sizes)} files, {sum(sizes) / 1e6:.0f} MB"


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {one}" for name, one in value.items() if one)
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
