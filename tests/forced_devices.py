"""Processes with several devices on one CPU."""

import os


def environment(devices: int) -> dict[str, str]:
    """The environment of a process with so many devices, which compiles quickly."""
    flags = os.environ.get("XLA_FLAGS", "")
    return os.environ | {
        "XLA_FLAGS": f"{flags} --xla_force_host_platform_device_count={devices}",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }
