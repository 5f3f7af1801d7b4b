"""`jaxshape view`: show a result in the browser, also while it is being made."""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from tyro.conf import Positional

from jaxshape.cli.common import require


@dataclass(frozen=True)
class ViewResult:
    """Show a result folder in the browser: the shape, grids and cameras, or the objects of a scene,
    which can be turned and switched on and off. While the folder is being written, the view is
    updated.

    Example: jaxshape view out/demo
    """

    result: Positional[Path]
    """Folder made by `jaxshape reconstruct`, `scene` or `demo`, finished or not."""
    port: int = 8080
    """Port to serve on, 1 to 65535; the next free one if it is taken."""
    host: str = "127.0.0.1"
    """Address to listen on; with any other than the default, others on the network can see the
    result."""

    def run(self) -> None:
        require(
            find_spec("viser") is not None,
            "jaxshape view needs viser, which is not installed: pip install 'jaxshape[viewer]'. "
            "report.html in the result folder shows the same without it.",
        )
        require(1 <= self.port <= 65535, f"--port is {self.port}; give 1 to 65535.")
        require(
            self.result.is_dir(),
            f"There is no folder {str(self.result)!r}; give one made by jaxshape reconstruct.",
        )
        from jaxshape.report.viewer import view

        def show_address(address: str) -> None:
            print(f"{address} shows {self.result}; Ctrl-C ends", flush=True)

        view(self.result, host=self.host, port=self.port, on_start=show_address)
