"""Description of the machine that made the results, so that readers can compare figures. [host]"""

import os
import platform
from collections.abc import Iterable
from importlib import metadata
from typing import Any

import jax

from jaxshape.process import processor


def describe_machine(packages: Iterable[str]) -> dict[str, Any]:
    """Processor, device and versions.

    Args:
        packages: Names of the packages whose versions are reported; None is reported for one that
            is missing.
    """
    model, features = processor()
    return {
        "processor": model,
        "cores": _cores(),
        "features": [f for f in ("avx2", "avx512f", "avx512_bf16", "amx_bf16") if f in features],
        "device": jax.devices()[0].device_kind if jax.default_backend() != "cpu" else "cpu",
        "system": platform.system(),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in packages},
    }


def load() -> float | None:
    """Load of the last minute: runnable processes for each core; None if not known.

    The load is that of the whole machine, hence so is the number of cores.
    """
    if not hasattr(os, "getloadavg"):
        return None
    return round(os.getloadavg()[0] / (os.cpu_count() or 1), 2)


def _cores() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
