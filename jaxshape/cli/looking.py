"""`jaxshape next`: suggest the next views of an object."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from jaxshape import checks
from jaxshape.claim import Output
from jaxshape.cli.common import console, require


@dataclass(frozen=True)
class NextView:
    """Suggest where to film an object from next: views that reveal most of its hidden parts.

    Left and right are those of the object, as for a person sitting on the chair.

    Example: jaxshape next out/reconstruct
    """

    result: Positional[Path]
    """Finished folder made by `jaxshape reconstruct` or `jaxshape demo`."""
    distance: float | None = None
    """Distance of the camera from the object's centre, in metres; by default that of the
    recording."""

    def __post_init__(self) -> None:
        if self.distance is not None:
            checks.positive("distance", self.distance, "metres")

    @property
    def writes(self) -> Output:
        """The output folder."""
        return Output(self.result, goes_on=True)

    def run(self) -> None:
        require(
            (self.result / "grid.npz").is_file(),
            f"{str(self.result)!r} holds no grid.npz; give a finished folder of jaxshape "
            "reconstruct or demo.",
        )
        from jaxshape.files import write_json
        from jaxshape.report.next_views import write_next_views
        from jaxshape.results.looking import look

        with console.status("looking around the object"):
            looked = look(self.result, distance=self.distance)
            write_next_views(self.result / "next_views.png", looked)
        write_json(self.result / "next.json", as_json(looked))
        for number, view in enumerate(as_json(looked)["views"], 1):
            print(f"{number}: {view['where']}: {view['share']:.0%} of what is uncertain")
        print(f"wrote next_views.png and next.json to {self.result}")


def as_json(looked: Any) -> dict[str, Any]:
    """The best views; lengths in metres, entropy in nats, poses in the object frame."""
    import numpy as np

    views, entropy = looked.views, float(looked.views.entropy)
    poses = np.asarray(views.T_object_camera.as_matrix())
    return {
        "entropy": round(entropy, 1),
        "views": [
            {
                "where": where,
                "gain": round(float(views.gain[i]), 1),
                "share": round(float(views.gain[i]) / max(entropy, 1e-9), 4),
                "T_object_camera": np.round(poses[i], 5).tolist(),
            }
            for i, where in zip(looked.best, looked.sentences(), strict=True)
        ],
    }
