"""Every wrong value of the settings of data and mapping is refused where it is made."""

import dataclasses
import math

import pytest

from jaxshape.data.camera_config import CameraConfig
from jaxshape.data.config import DatasetConfig, FaultConfig, InputConfig
from jaxshape.data.render import SensorNoise
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.placement.placing import PlacementConfig
from jaxshape.mapping.segmentation.segment import Prompt
from jaxshape.model.config import Architecture, Completion, TrainConfig

SHARE = (-0.1, 1.5, math.nan)
POSITIVE = (0.0, -1.0, math.inf, math.nan)
COUNT = (0, -1)
SWITCH = ("yes",)

WRONG = {
    FaultConfig: dict.fromkeys(("pose_error", "missing", "segmentation", "hidden", "loose"), SHARE),
    DatasetConfig: {"paths": (*COUNT, 10**9), "frames": ((), (2, 1), (0,), (1, 10**9)),
                    "cameras": ((), ("polaroid",)),
                    "noisy": SHARE, "arcs": SHARE, "up": ("w", "+x"), "front": ("",),
                    "resolution": (0, 33, 24), "seed": (-1, 2**32), "unit": ("ell",)},
    Architecture: {"encoder": ((), (4, 0, 8), (10**9,)), "decoder": ((0,),),
                   "code": (*COUNT, 1, 10**9), "occlusion": SWITCH},
    Completion: {"channels": ((4, 0, 8), (10**9, 1, 1)), "depth": (*COUNT, 10**9),
                 "code": (*COUNT, 1), "resolution": (0, 12, 4, 8 * 10**9)},
    TrainConfig: {"steps": (*COUNT, 10**9), "batch": (*COUNT, 10**9), "optimizer": ("sgd",),
                  "learning_rate": POSITIVE,
                  "schedule": ("linear",), "occupied_weight": POSITIVE, "occluded_weight": POSITIVE,
                  "average": SHARE, "posterior_share": SHARE, "validation": (-1,),
                  "code_noise": (-1.0,),
                  "code_weight": (math.inf,), "report_every": COUNT, "seed": (-1, 2**64)},
    InputConfig: {"complete": SHARE, "mirror": SWITCH, "warp": (*SHARE, 1.0)},
    SensorNoise: {"axial": (-1e-3, math.inf), "lateral": (-0.1, math.nan),
                  "quantization": POSITIVE, "dropout": SHARE, "grazing": (-1.0, 181.0)},
    CameraConfig: {"camera": ("Kinect", ""), "noise": SWITCH, "fusion": ("tsdf",)},
    TrackingConfig: {"against": ("maps", "Map"), "on": ("objects",), "min_inliers": SHARE,
                     "sure_inliers": SHARE, "min_overlap": SHARE, "max_angle": POSITIVE,
                     "max_distance": POSITIVE, "correct_poses": SWITCH},
    MappingConfig: {"keyframe_angle": POSITIVE, "keyframe_distance": POSITIVE, "realign": SWITCH,
                    "isotropic": SWITCH, "fusion": ("point",), "depth_noise": POSITIVE,
                    "min_hits": COUNT, "keyframe_iterations": (*COUNT, 10**9)},
    PlacementConfig: {"typical_size": ((0.5, 0.0, 0.5),), "size_spread": ((0.5, math.nan, 0.5),),
                      "yaws": COUNT, "overhangs": ((0.0, -0.2),), "kept": (*COUNT, 1000),
                      "steps": COUNT, "steps_again": COUNT},
    Prompt: {"number": COUNT, "click": ((-1.0, 5.0), (math.nan, 5.0)),
             "region": ((30.0, 0.0, 20.0, 10.0), (0.0, 5.0, 9.0, 5.0)),
             "depth_range": ((2.0, 1.0), (-1.0, 2.0), (1.0, math.nan))},
}  # fmt: skip
SWITCHED = {"bfloat16"}
CASES = [
    (settings, name, value)
    for settings, fields in WRONG.items()
    for name, values in fields.items()
    for value in values
]


@pytest.mark.parametrize(("settings", "name", "value"), CASES)
def test_a_wrong_value_is_refused_in_one_sentence(settings, name, value):
    wrong = settings()
    object.__setattr__(wrong, name, value)  # the tests' type checker would refuse it before
    with pytest.raises(ValueError) as refusal:
        wrong.__post_init__()
    said = str(refusal.value)
    assert said.startswith(f"{name} is ") and "; give " in said and said.endswith(".")
    assert said.count(".") == said.rstrip(".").count(".") + 1


@pytest.mark.parametrize("settings", WRONG)
def test_no_field_goes_unchecked(settings):
    """But those whose values check themselves, and switches."""
    fields = {f.name for f in dataclasses.fields(settings)}
    nested = {name for name in fields if dataclasses.is_dataclass(getattr(settings(), name))}
    assert set(WRONG[settings]) == fields - nested - SWITCHED


def test_axes_on_one_line_are_refused():
    with pytest.raises(ValueError, match="up is 'z' and front is 'z', but they must be perp"):
        DatasetConfig(up="z")
