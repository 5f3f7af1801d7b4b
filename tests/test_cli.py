"""The command line: what is refused, in one sentence and with nothing touched, and what works."""

import io
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from itertools import islice

import jax
import numpy as np
import pytest
import trimesh
from marks import slow
from PIL import Image
from rich.console import Console
from scene import write_scene

from jaxshape import cli, process
from jaxshape.cli import collection as collections
from jaxshape.cli import common
from jaxshape.cli.learning import preset_in
from jaxshape.cli.options import Axes
from jaxshape.data import building, dataset
from jaxshape.data.archives import MeshSource, list_meshes
from jaxshape.data.camera_config import CameraConfig
from jaxshape.data.chairs import random_chair
from jaxshape.data.families import TEST_SEEDS
from jaxshape.data.meshes import Skipped
from jaxshape.data.split import hold_out
from jaxshape.data.survey import look
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map import mapper
from jaxshape.mapping.placement import finding
from jaxshape.mapping.segmentation.segment import Prompt
from jaxshape.model import training
from jaxshape.model.config import PRESETS
from jaxshape.model.weights import fingerprint, load_card, load_prior, save_prior
from jaxshape.report.plots import plot_search
from jaxshape.results import evaluation
from jaxshape.results.traces import read_search
from jaxshape.search.config import RefineConfig
from jaxshape.search.names import families

COMMANDS = (
    "demo", "dataset", "train", "reconstruct", "complete", "inspect", "evaluate", "plot", "view",
    "doctor", "bench",
)  # fmt: skip


@pytest.fixture
def linear(linear_weights):
    """The option that chooses weights which compile at once."""
    return "--weights", linear_weights


# --- help -------------------------------------------------------------------------------------


def test_help_answers_with_an_example_and_without_jax():
    program = f"""
import sys
from jaxshape import cli
for command in {COMMANDS}:
    sys.argv = ["jaxshape", command, "--help"]
    try:
        cli.main()
    except SystemExit as stop:
        assert not stop.code, command
    print("end of", command)
assert "jax" not in sys.modules, "jax was imported"
"""
    environment = os.environ | {"COLUMNS": "200", "NO_COLOR": "1"}
    answer = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env=environment
    )
    assert answer.returncode == 0, answer.stderr
    for command in COMMANDS:
        text = answer.stdout.split(f"end of {command}")[0].rsplit("end of", 1)[-1]
        assert re.search(rf"Examples?:\s.*jaxshape {command}", text, re.DOTALL), command
    assert all(f" {family}," in answer.stdout for family in ("encoder", *families()))


# --- bad input --------------------------------------------------------------------------------


FRAMES = 3


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "frames"
    write_scene(folder, random_chair(2, style="side chair"), frames=FRAMES)
    return folder


@pytest.fixture
def frames(scene, tmp_path):
    """A copy to break."""
    copy = tmp_path / "frames"
    copy.mkdir()
    for path in scene.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    return copy


@pytest.fixture
def refused(run, tmp_path):
    """Run a command that must fail with status 2, and leave earlier output as it was."""

    def refused(command, *arguments, output=None):
        output = output or tmp_path / "out"
        output.mkdir(parents=True, exist_ok=True)
        kept = output / "result.json"
        kept.write_text("earlier")
        target = kept if command == "evaluate" else output
        status, out, err = run(command, *arguments, "--output", target)
        assert status == 2 and not out, (status, out, err)
        assert kept.read_text() == "earlier"
        assert list(output.iterdir()) == [kept]
        assert "Traceback" not in err and err.count("jaxshape:") == 1
        complaint = err.split("jaxshape:", 1)[1].strip()
        assert complaint.endswith(".") or complaint.endswith("?"), complaint
        return complaint

    return refused


def rewrite_box(folder, **changed):
    box = json.loads((folder / "box.json").read_text())
    (folder / "box.json").write_text(json.dumps(box | changed))


def in_metres(folder):
    for path in folder.glob("*.depth.png"):
        Image.fromarray((np.array(Image.open(path)) // 1000).astype(np.uint16)).save(path)


def move_the_box(folder):
    T = np.eye(4)
    T[:3, 3] = 100
    rewrite_box(folder, T_world_object=T.tolist())


@pytest.mark.parametrize(
    "damage, said",
    [
        (in_metres, "--depth-scale"),
        slow(move_the_box, "Nothing was measured inside the object's box"),
        (lambda folder: (folder / "box.json").write_text("{"), "cannot be read as JSON"),
        (lambda folder: rewrite_box(folder, size=[1, -1, 1]), "expected positive extents"),
        (lambda folder: (folder / "camera-intrinsics.txt").unlink(), "is missing"),
    ],
)
def test_a_damaged_scan_is_refused(frames, refused, damage, said, linear):
    damage(frames)
    assert said in refused("reconstruct", *linear, frames, "--box", frames / "box.json")


def test_a_missing_folder_or_box_is_refused(frames, refused, tmp_path, linear):
    assert "is not a folder" in refused("reconstruct", *linear, tmp_path / "nowhere")
    assert "cannot be read" in refused(
        "reconstruct", *linear, frames, "--box", tmp_path / "nowhere.json"
    )


def test_a_recording_in_which_nothing_stands_out_is_refused(frames, refused, linear):
    for path in frames.glob("*.depth.png"):
        wall = np.full_like(np.array(Image.open(path)), 1500)
        Image.fromarray(wall).save(path)
    said = refused("reconstruct", *linear, frames)
    assert "say where it is with --click, --region, --depth-range or --box" in said
    assert "Nothing but floor, walls and table tops is seen" in said


def test_a_recording_is_not_written_into(frames, run, linear):
    before = {path.name: path.read_bytes() for path in frames.iterdir()}
    for command in ("reconstruct", "scene"):
        given = linear if command == "reconstruct" else ()
        status, out, err = run(command, *given, frames, "--output", frames / ".." / "frames")
        assert status == 2 and not out and "is the recording itself" in err
    assert {path.name: path.read_bytes() for path in frames.iterdir()} == before


def test_poses_that_are_all_lost_are_refused_with_what_to_do(frames, refused, linear):
    for path in frames.glob("*.pose.txt"):
        np.savetxt(path, np.full((4, 4), np.nan))
    for box in ((), ("--box", frames / "box.json")):
        said = refused("reconstruct", *linear, frames, *box)
        assert "add --poses none to track the camera" in said


def test_poses_that_are_missing_or_do_not_fit_are_refused(frames, refused, linear):
    some = ("reconstruct", *linear, frames, "--box", frames / "box.json")
    paths = sorted(frames.glob("*.pose.txt"))
    for number, path in enumerate(paths):
        T = np.loadtxt(path)
        T[1, 3] += 0.5 * number
        np.savetxt(path, T)
    said = refused(*some)
    assert "agree with the depth images on" in said and "add --poses none to track" in said
    for path in paths:
        path.unlink()
    for poses in ("given", "first"):
        assert f"--poses is {poses}, but" in refused(*some, "--poses", poses)


def test_a_camera_that_is_a_guess_is_refused_unless_it_is_asked_for(tmp_path, refused, linear):
    wall = np.full((48, 64), 1500, np.uint16)
    (tmp_path / "scan/depth").mkdir(parents=True)
    for number in range(2):
        Image.fromarray(wall).save(tmp_path / f"scan/depth/{number}.png")
    said = refused("reconstruct", *linear, tmp_path / "scan")
    assert "holds no camera" in said and "--guess-camera" in said and "cam_K.txt" in said
    said = refused("reconstruct", *linear, tmp_path / "scan", "--guess-camera")
    assert "The object was not found" in said


@pytest.fixture(scope="module")
def chair(tmp_path_factory):
    path = tmp_path_factory.mktemp("meshes") / "chair.ply"
    random_chair(3, style="side chair").export(path)
    return path


@pytest.mark.parametrize(
    "options, said",
    [
        (("--every", "0"), "--every is 0"),
        (("--first", "-1"), "--first is -1"),
        (("--first", "3"), "--first is 3, but there are 3 frames"),
        (("--depth-scale", "0"), "The depth scale is 0"),
        (("--click", "48", "20"), "The click is at 48, 20"),
        (("--object", "0"), "--object is 0; give a whole number, 1 or more"),
        (("--region", "60", "0", "70", "10"), "holds no pixel of the image of 48 x 48"),
        (("--region", "30", "0", "20", "10"), "--region is 30.0 0.0 20.0 10.0"),
        (("--depth-range", "2", "1"), "--depth-range is 2.0 1.0"),
        (("--min-hits", "0"), "--min-hits is 0"),
        (("--keyframe-angle", "0"), "--keyframe-angle is 0"),
        (("--keyframe-distance", "nan"), "--keyframe-distance is nan"),
        (("--keyframe-iterations", "0"), "--keyframe-iterations is 0"),
        (("--min-inliers", "1.5"), "--min-inliers is 1.5"),
        (("--min-overlap", "-0.1"), "--min-overlap is -0.1"),
        (("--max-angle", "0"), "--max-angle is 0"),
        (("--max-distance", "inf"), "--max-distance is inf"),
        (("--seed", "-1"), "--seed is -1; give a whole number, 0 or more"),
        (("--depth-scale", "inf"), "The depth scale is inf"),
        (("--depth-scale", "nan"), "The depth scale is nan"),
        (("--click", "nan", "1"), "--click is nan"),
    ],
)
def test_options_of_a_scan_out_of_range_are_refused(scene, refused, tmp_path, options, said, prior):
    save_prior(tmp_path / "tiny.safetensors", prior, {})
    some = ("--box", scene / "box.json", "--weights", tmp_path / "tiny.safetensors")
    assert said in refused("reconstruct", scene, *some, *options)


@pytest.mark.parametrize(
    "options, said",
    [
        (("--iterations", "0"), "--iterations is 0"),
        (("--population", "2"), "--population is 2"),
        (("--population", "1000000000"), "3 to 100000: each is a shape to decode"),
        (("--iterations", "1000000000"), "--iterations is 1000000000"),
        (("--seed", str(2**64)), "0 to 4294967295: random keys have 32 bits"),
        (("--sigma0", "0"), "--sigma0 is 0"),
        (("--sigma0", "nan"), "--sigma0 is nan"),
        (("--step-size", "-1"), "--step-size is -1"),
        (("--bound", "0"), "--bound is 0"),
        (("--prior-weight", "inf"), "--prior-weight is inf"),
        (("--tolerance", "-1"), "--tolerance is -1"),
        (("--target", "nan"), "--target is nan"),
        (("--method", "magic"), "no method 'magic'"),
        (("--method", "cma:magic"), "no method 'cma:magic'"),
        (("--method", "gradient:magic"), "no optimiser 'magic'"),
        (("--method", "evosax:magic"), "no evosax strategy 'magic'"),
        (("--weights", "nowhere.safetensors"), "There is no weights file"),
    ],
)
def test_a_search_that_cannot_be_is_refused_before_frames_are_read(
    refused, tmp_path, options, said, linear
):
    if "--weights" not in options:
        options = (*options, *linear)
    assert said in refused("reconstruct", tmp_path / "no such frames", *options)


def test_a_search_of_ones_own_is_found_in_the_current_folder(refused, tmp_path, monkeypatch):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "search.py").write_text("def build(variant, *_): raise ValueError(variant)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    name = "own.search:build@Reached."
    assert refused("reconstruct", tmp_path / "frames", "--method", name) == "Reached."


@pytest.mark.parametrize(
    "options, said",
    [
        (("--frames", "1,x"), "--frames is '1,x'"),
        (("--frames", "0"), "--frames is '0'"),
        (("--frames", "2,2"), "--frames is '2,2'"),
        (("--frames", "1,1000000000"), "--frames is 1000000000; give a whole number, 1 to 180"),
        (("--seed", str(2**64)), "0 to 4294967295"),
        (("--methods", "encoder,magic"), "no method 'magic'"),
        (("--up", "z"), "must be perpendicular"),
        (("--noise", "--no-noise"), "Give --noise or --no-noise, not both"),
    ],
)
def test_options_of_an_evaluation_out_of_range_are_refused(
    chair, refused, tmp_path, options, said, prior
):
    save_prior(tmp_path / "tiny.safetensors", prior, {})
    some = ("--meshes", chair, "--weights", tmp_path / "tiny.safetensors")
    assert said in refused("evaluate", *some, *options)


def test_meshes_that_cannot_be_used_are_refused(chair, refused, tmp_path, prior, monkeypatch):
    save_prior(tmp_path / "tiny.safetensors", prior, {})
    tiny = ("--weights", tmp_path / "tiny.safetensors")
    (tmp_path / "empty.ply").write_bytes(b"")
    said = refused("evaluate", "--meshes", tmp_path / "empty.ply", *tiny)
    assert "None of the 1 meshes can be used" in said and "empty" in said
    refused("evaluate", "--meshes", tmp_path / "nowhere.ply", *tiny)

    lying = trimesh.load_mesh(chair)
    lying.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    lying.export(tmp_path / "lying.ply")
    monkeypatch.setattr(collections, "_scores", lambda *_, **__: {})
    said = refused("evaluate", "--meshes", tmp_path / "lying.ply")
    assert "lie on their side" in said and "--up z" in said


def test_other_weights_are_refused(chair, refused, tmp_path, prior):
    said = refused("evaluate", "--meshes", chair, "--weights", tmp_path / "nowhere.safetensors")
    assert "There is no weights file" in said
    (tmp_path / "noise.safetensors").write_bytes(b"not weights")
    said = refused("evaluate", "--meshes", chair, "--weights", tmp_path / "noise.safetensors")
    assert "is not a readable safetensors file" in said
    swapped = jax.tree.map(lambda x: x, prior.params)
    swapped["params"]["decoder"]["conv1"] = swapped["params"]["decoder"]["conv1"][..., :3]
    save_prior(tmp_path / "other.safetensors", prior._replace(params=swapped), {})
    said = refused("evaluate", "--meshes", chair, "--weights", tmp_path / "other.safetensors")
    assert "weights of another architecture" in said


@pytest.mark.parametrize(
    "options, said",
    [
        (("--steps", 0), "--steps is 0"),
        (("--batch", 0), "--batch is 0"),
        (("--learning-rate", 0), "--learning-rate is 0"),
        (("--learning-rate", "nan"), "--learning-rate is nan"),
        (("--occupied-weight", 0), "--occupied-weight is 0"),
        (("--code-noise", -1), "--code-noise is -1"),
        (("--code-weight", "inf"), "--code-weight is inf"),
        (("--report-every", 0), "--report-every is 0"),
        (("--preset", "paper", "--encoder", 4, 0, 8, 8), "--encoder is 4 0 8 8"),
        (("--code", 1), "--code is 1"),
        (("--channels", 4, 0, 8), "--channels is 4 0 8"),
        (("--complete", 1.1), "--complete is 1.1"),
        (("--warp", 1), "--warp is 1"),
        (("--average", -0.1), "--average is -0.1"),
        (("--name", "a/b"), "--name is 'a/b'"),
        (("--meshes", "mugs"), "either --dataset FOLDER or --meshes FOLDER"),
        (("--start", "nowhere.safetensors"), "There is no weights file"),
        (("--process", 1), "Without coordinator and processes"),
        (("--processes", 2, "--process", 2), "--process is 2 of 2"),
    ],
)
def test_a_training_run_that_cannot_be_is_refused(refused, tmp_path, options, said):
    assert said in refused("train", "--dataset", tmp_path / "nowhere", *options)


def test_a_collection_of_meshes_that_cannot_be_trained_on_is_refused(chair, refused, tmp_path):
    assert "either --dataset FOLDER or --meshes FOLDER" in refused("train")
    assert "two or more shapes" in refused("train", "--meshes", chair)
    assert "must be perpendicular" in refused("train", "--meshes", chair, "--front", "-y")
    assert "no file or folder" in refused("train", "--meshes", tmp_path / "nowhere")


def test_a_missing_dataset_is_refused(refused, tmp_path):
    assert "There is no dataset" in refused("train", "--dataset", tmp_path / "nowhere")
    assert "--count is 0" in refused("dataset", "--count", 0)
    assert "--paths is 0" in refused("dataset", "--paths", 0)
    assert "--missing is -0.1" in refused("dataset", "--missing", -0.1)
    assert "--noisy is 1.5" in refused("dataset", "--noisy", 1.5)


# --- what works -------------------------------------------------------------------------------

RESULTS = {
    "mesh.glb", "mesh.ply", "grid.npz", "trace.npz", "overview.png", "result.json", "report.html"
}  # fmt: skip


def test_reconstruct_writes_its_files(run, frames, tmp_path, linear):
    """A damaged frame costs that frame alone, and is said."""
    damaged = frames / "frame-000001.depth.png"
    damaged.write_bytes(damaged.read_bytes()[:60])
    output = tmp_path / "out"
    few = ("--iterations", 2, "--keyframe-iterations", 1, "--min-hits", 1)
    arguments = (frames, "--box", frames / "box.json", *few, "--output", output)
    status, out, err = run("reconstruct", *linear, *arguments)
    assert status == 0, err
    of_recordings = {"keyframes", "keyframes.json", "trajectory.txt", "trajectory.log"}
    assert {path.name for path in output.iterdir()} == RESULTS | of_recordings
    result = json.loads((output / "result.json").read_text())
    assert (result["frames"], result["keyframes"], result["frames_unreadable"]) == (3, 2, 1)
    assert result["seconds"] > 0 and "running" not in result
    assert (result["iterations"], result["evaluations"]) == (2, 3)
    assert result["stop"] == "budget" and result["search"]["iterations"] == 2
    assert result["objective_refined"] <= result["objective_encoder"]
    assert any("cannot be read as an image" in warning for warning in result["warnings"])
    assert result["verdict"] in ("good", "doubtful") and f"verdict: {result['verdict']}" in out
    assert result["quality"]["keyframes"] == 2 and len(result["quality"]["size"]) == 3
    assert "3 frames, 2 of them keyframes, 1 left out" in out
    assert "frame-000001: unreadable" in err and "cannot be read as an image" in err
    assert "objective:" in out and str(output) in out

    status, out, err = run("plot", output)
    assert status == 0 and str(output / "trace.png") in out, err
    plot_search(tmp_path / "again.png", read_search(output))
    assert (tmp_path / "again.png").read_bytes() == (output / "trace.png").read_bytes()
    status, out, err = run("plot", output, output, "--output", tmp_path / "compare.svg")
    assert status == 0 and (tmp_path / "compare.svg").exists(), err


def test_options_reach_the_map_and_the_search_of_the_object(
    run, scene, tmp_path, linear, monkeypatch
):
    asked = {}

    def build_mapper(prior, refiner, search, mapping, tracking, *, seed):
        asked.update(search=search, mapping=mapping, tracking=tracking, seed=seed)

    def find_start(sequence, prior, prompt, **options):
        asked.update(prompt=prompt, options=options)
        raise OSError("enough.")

    monkeypatch.setattr(mapper, "build_mapper", build_mapper)
    monkeypatch.setattr(finding, "find_start", find_start)
    prompt = ("--click", 10, 20, "--region", 0, 0, 40, 40.5, "--depth-range", 0.5, 3)
    tracking = ("--against", "keyframe", "--on", "object", "--min-inliers", 0.5, "--max-angle", 9)
    mapping = ("--no-realign", "--isotropic", "--fusion", "points", "--min-hits", 2)
    mapping += ("--keyframe-angle", 7)
    options = ("--poses", "none", "--first", 1, "--seed", 5, "--output", tmp_path)
    status, _, err = run("reconstruct", *linear, scene, *prompt, *tracking, *mapping, *options)
    assert status == 2 and "enough" in err, err
    assert asked["prompt"] == Prompt((10.0, 20.0), (0.0, 0.0, 40.0, 40.5), (0.5, 3.0))
    assert asked["tracking"] == TrackingConfig("keyframe", "object", 0.5, max_angle=9.0)
    assert asked["mapping"] == MappingConfig(
        7.0, realign=False, isotropic=True, fusion="points", min_hits=2
    )
    assert asked["options"] == {"box": None, "first": 1, "use_pose": False} and asked["seed"] == 5


def test_plots_of_other_folders_are_refused(run, tmp_path):
    for arguments, said in (((tmp_path,), "is not a result folder"), ((), "one result folder")):
        status, out, err = run("plot", *arguments)
        assert status == 2 and said in err and not out


def test_demo_compares_with_the_truth_and_repeats_itself(run, tmp_path, linear):
    results = []
    for name in ("first", "second"):
        arguments = ("--frames", 2, "--method", "gradient", "--iterations", 2)
        status, out, err = run("demo", *linear, *arguments, "--output", tmp_path / name)
        assert status == 0 and "IoU with the true surface" in out, err
        assert {path.name for path in (tmp_path / name).iterdir()} == RESULTS
        results.append(json.loads((tmp_path / name / "result.json").read_text()))
    for score in ("iou_encoder", "iou_refined", "iou_composed"):
        assert 0 <= results[0][score] <= 1
    assert results[0].pop("seconds") > 0 and results[1].pop("seconds") > 0
    assert results[0] == results[1]
    seen = {"camera": "kinect", "noise": True, "fusion": "distance"}
    assert results[0].items() >= seen.items() and results[0]["search"]["objective"] == "soft"
    assert 0 < results[0]["mesh_measured"] < 1 and 0 < results[0]["symmetry_agreement"] <= 1


@pytest.mark.slow
def test_demo_of_a_table_as_in_the_paper(run, tmp_path, linear):
    """Clean square images, points in voxels, nothing mirrored."""
    few = ("--frames", 2, "--method", "encoder")
    paper = ("--camera", "paper", "--no-symmetry", "--objective", "paper")
    status, _, err = run("demo", "--family", "table", *linear, *few, *paper, "--output", tmp_path)
    assert status == 0, err
    result = json.loads((tmp_path / "result.json").read_text())
    seen = {"camera": "paper", "noise": False, "fusion": "points"}
    assert result.items() >= seen.items() and result["search"]["objective"] == "paper"
    assert result["object"] == f"procedural table {TEST_SEEDS}"
    assert not result.keys() & {"symmetric", "symmetry_agreement", "mesh_measured"}
    with np.load(tmp_path / "grid.npz") as grids:
        F, M, completed = (grids[name] for name in ("occupied", "occluded", "refined"))
        np.testing.assert_array_equal(grids["composed"], np.where(M, completed, F))


def test_evaluate_writes_scores_of_each_mesh_and_their_means(run, chair, tmp_path, linear):
    path = tmp_path / "scores.json"
    arguments = ("--frames", "1,2", "--methods", "encoder,gradient", "--iterations", 2)
    status, out, err = run("evaluate", *linear, "--meshes", chair, *arguments, "--output", path)
    assert status == 0, err
    content = json.loads(path.read_text())
    assert set(content) == {"config", "skipped", "per_mesh", "means"}
    assert content["config"]["frames"] == [1, 2] and content["config"]["seconds"] > 0
    seen = {"camera": "kinect", "noise": True, "fusion": "distance"}
    assert content["config"].items() >= seen.items()
    assert set(content["means"]) == {"1", "2"}
    assert set(content["means"]["1"]) == {"encoder", "gradient", "bounds"}
    assert content["per_mesh"][0]["frames"] == content["means"]
    assert "encoder" in out and "gradient" in out


@pytest.mark.parametrize(
    "options, expected",
    [
        ((), CameraConfig()),
        (("--noise",), CameraConfig(noise=True)),
        (
            ("--camera", "realsense", "--no-noise", "--fusion", "points"),
            CameraConfig(camera="realsense", noise=False, fusion="points"),
        ),
    ],
)
def test_the_camera_and_the_switches_of_a_search_reach_the_evaluation(
    run, chair, tmp_path, linear, monkeypatch, options, expected
):
    asked = []

    def evaluate(prior, models, config):
        asked.append(config)
        raise OSError("enough.")

    monkeypatch.setattr(evaluation, "evaluate", evaluate)
    search = ("--no-symmetry", "--objective", "paper")
    output = ("--output", tmp_path / "scores.json")
    assert run("evaluate", *linear, "--meshes", chair, *options, *search, *output)[0] == 2
    (config,) = asked
    for name in ("camera", "noise", "fusion"):
        assert getattr(config, name) == getattr(expected, name)
    assert config.refine == RefineConfig(objective="paper", symmetry=False)


def test_a_killed_evaluation_goes_on_with_the_same_weights_and_meshes_only(
    run, chair, tmp_path, monkeypatch, linear_prior
):
    asked, weights = [], tmp_path / "weights.safetensors"
    save_prior(weights, linear_prior, {})

    def evaluate(prior, models, config):
        asked.append(len(models))
        for model in models:
            scores = {"1": {"encoder": {"iou": 1.0}, "bounds": {"occluded_empty": 1.0}}}
            yield {"name": model.name, "content": model.digest, "metadata": {}, "frames": scores}
            if len(asked) < 4:
                raise OSError("killed.")

    monkeypatch.setattr(evaluation, "evaluate", evaluate)
    (tmp_path / "meshes").mkdir()
    for name in ("a.ply", "b.ply", "c.ply"):
        (tmp_path / "meshes" / name).write_bytes(chair.read_bytes())
    arguments = ("--meshes", tmp_path / "meshes", "--frames", 1, "--methods", "encoder")
    arguments += ("--weights", weights)
    for status in (2, 2, 2, 0):
        assert run("evaluate", *arguments, "--output", tmp_path / "scores.json")[0] == status
        if len(asked) == 1:
            save_prior(weights, linear_prior._replace(code_mean=linear_prior.code_mean + 1), {})
        if len(asked) == 2:  # the mesh that was scored is another one now
            mesh = trimesh.load_mesh(chair).apply_scale((1, 1, 1.2))
            mesh.export(tmp_path / "meshes" / "a.ply")
    assert asked == [3, 3, 3, 2]


def scores_of(**best):
    """Scores of meshes that fit one pair of axes clearly, by name."""
    pairs = [("y", "z"), ("y", "x"), ("z", "-y")]
    return {
        name: {pair: -0.3 - 0.1 * (pair != own) for pair in pairs} for name, own in best.items()
    }


@pytest.mark.parametrize(
    ("fronts", "lying", "said"),
    [
        ("xxxz", [], "3 of 4 meshes that were looked at seem to face another way, for example 'a'; "
         "give --up y --front x."),
        ("zzzx", [], "1 of 4 meshes that were looked at seem to face another way than the rest: d"),
        ("zzzz", ["c"], "1 of 4 meshes seem to lie on their side, if they are seats: c; --axes "),
        ("zzzz", [], ""),
    ],
)  # fmt: skip
def test_a_collection_votes_on_its_axes(monkeypatch, fronts, lying, said):
    sources = [MeshSource(name, f"/{name}.obj") for name in "abcd"]
    scores = scores_of(**{name: ("y", front) for name, front in zip("abcd", fronts, strict=True)})
    warned = []
    monkeypatch.setattr(collections, "_scores", lambda *_, **__: scores)
    monkeypatch.setattr(collections, "warn", warned.append)
    collections.check_axes(sources, lying, Axes())
    assert len(warned) == bool(said) and said in "".join(warned)


def test_each_mesh_gets_its_own_axes_where_they_are_asked_for(monkeypatch):
    sources = [MeshSource(name, f"/{name}.obj") for name in "abc"]
    scores = scores_of(a=("z", "-y"), b=("z", "-y"), c=("y", "z"))
    monkeypatch.setattr(collections, "_scores", lambda *_, **__: scores)
    assert collections.turned(sources, Axes()) == sources
    axes = [source.axes for source in collections.turned(sources, Axes(axes="auto"))]
    assert axes == [("z", "-y"), ("z", "-y"), ("y", "z")]


def test_reasons_come_in_a_table(monkeypatch):
    written = io.StringIO()
    monkeypatch.setattr(common, "console", Console(file=written, width=200))
    skipped = [Skipped(f"m{i}", "unreadable", "It is cut.") for i in range(5)]
    common.report_skipped([*skipped, Skipped("x", "flat", "One axis.")])
    common.report_notes([("m1", "collider left out: 'UCX_a'."), ("m2", "collider left out: 'b'.")])
    assert written.getvalue().splitlines() == [
        "skipped 5 unreadable: m0, m1, m2 and 2 more. m0: It is cut.",
        "skipped 1 flat: x. One axis.",
        "left out collider of 2 meshes: m1, m2. m1: collider left out: 'UCX_a'.",
    ]


# --- training ---------------------------------------------------------------------------------


def test_a_preset_gives_the_defaults_of_the_other_options(monkeypatch):
    assert preset_in(["train", "--preset=paper", "--front", "-y"]) == "paper"
    for preset, arguments, changed in (
        ("default", (), {}),
        ("paper", (), {}),
        ("paper", ("--steps", "7"), {"steps": 7}),
        ("default", ("--learning-rate", "0.5"), {"learning_rate": 0.5}),
    ):
        asked = []
        monkeypatch.setattr(cli.Train, "run", lambda command, asked=asked: asked.append(command))
        for order in ((*arguments, "--preset", preset), ("--preset", preset, *arguments)):
            monkeypatch.setattr(sys, "argv", ["jaxshape", "train", "--dataset", "data", *order])
            cli.main()
        assert [command.config for command in asked] == 2 * [replace(PRESETS[preset], **changed)]
    nested = ("--code", "12", "--no-mirror", "--decoder", "8", "4", "2")
    monkeypatch.setattr(sys, "argv", ["jaxshape", "train", "--preset", "paper", *nested])
    cli.main()
    assert asked[-1].config.architecture == replace(
        PRESETS["paper"].architecture, code=12, decoder=(8, 4, 2)
    )
    assert asked[-1].preset == "paper" and not asked[-1].config.inputs.mirror


def test_help_shows_the_values_of_the_preset(run):
    for preset, steps in (("default", PRESETS["default"].steps), ("paper", PRESETS["paper"].steps)):
        status, out, _ = run("train", "--preset", preset, "--help")
        assert status == 0 and f"(default: {steps})" in out
        assert "srun" in out and "--coordinator" in out


@pytest.mark.parametrize("options, asked", [
    (("--distributed",), (None, None, None)),
    (("--coordinator", "host:1", "--processes", 2, "--process", 1), ("host:1", 2, 1)),
    ((), None),
])  # fmt: skip
def test_machines_join_before_anything_is_read(run, monkeypatch, tmp_path, options, asked):
    joined = []
    monkeypatch.setattr(process, "join_processes", lambda *given: joined.append(given))
    assert run("train", "--dataset", tmp_path / "nowhere", *options)[0] == 2
    assert joined == ([asked] if asked else [])


def test_only_the_first_process_speaks_and_writes(run, collection, tmp_path, monkeypatch, prior):
    run("dataset", "--meshes", collection, "--paths", 2, "--output", tmp_path / "data")
    for index in (1, 0):
        monkeypatch.setattr(jax, "process_index", lambda index=index: index)
        arguments = ("train", "--dataset", tmp_path / "data", "--output", tmp_path / "out")
        status, out, err = run(*arguments, *TINY)
        assert (status, bool(out), bool(err)) == (0, index == 0, index == 0)
        assert (tmp_path / "out" / "weights.safetensors").exists() == (index == 0)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "weights.safetensors", "weights.md", "card.json", "metrics.jsonl"
    }  # fmt: skip
    status, _, err = run("train", "--meshes", collection, "--output", tmp_path / "mesh", *TINY)
    assert status == 0, err
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    status, _, err = run("train", "--meshes", collection, "--output", tmp_path / "two", *TINY)
    assert status == 2 and "make it first with jaxshape dataset" in err


SIZES = ("--preset", "autoencoder", "--encoder", 4, 4, 8, 8, "--decoder", 8, 8, 4, "--code", 10)
TINY = ("--steps", 4, "--batch", 2, *SIZES)


@pytest.fixture
def collection(tmp_path, monkeypatch, prior):
    """A folder of twelve boxes, one unusable, and everything slow about training on it replaced."""
    folder = tmp_path / "boxes"
    folder.mkdir()
    for i in range(12):
        trimesh.creation.box((1, 2, 3 + i)).export(folder / f"box-{i}.ply")
    (folder / "empty.ply").write_bytes(b"")

    def paths(mesh, config, seed):
        random = np.random.default_rng(seed)
        surfaces = random.integers(0, 256, (config.paths, 4096), np.uint8)
        return surfaces, np.full((config.paths, len(config.frames), 32**3), 240, np.uint8)

    def train(folder, data, config, start=None):
        done = [report.step for report in training.read_metrics(folder)]
        for step in range(max(done, default=0) + 1, config.steps + 1):
            report = training.Report(step, 0.1 * step, 0.5, None, None, 10.0, 2.0)
            if jax.process_index() == 0:
                training._record(folder, report)
            yield report

    def evaluate(prior, models, config):
        scores = dict.fromkeys(("iou", "iou_composed", "chamfer_l1", "f_score", "objective"), 0.5)
        bounds = {"occluded_empty": 0.25, "occluded_full": 0.125}
        one = {method: scores for method in config.methods} | {"bounds": bounds}
        for model in models:
            frames = {str(k): one for k in config.frames}
            yield {"name": model.name, "content": model.digest, "metadata": {}, "frames": frames}

    monkeypatch.setattr(building, "in_processes", lambda f, items, _: enumerate(map(f, items)))
    monkeypatch.setattr(dataset, "object_paths", paths)
    monkeypatch.setattr(training, "train", train)
    monkeypatch.setattr(training, "finished_prior", lambda *_: prior)
    monkeypatch.setattr(evaluation, "evaluate", evaluate)
    return folder


def killed_after(function, count):
    """The generator, until it is killed after so many yields."""

    def part(*arguments, **settings):
        yield from islice(function(*arguments, **settings), count)
        raise OSError("killed.")

    return part


STAGES = ((building, "build_dataset"), (training, "train"), (evaluation, "evaluate"))


@pytest.mark.slow
def test_own_category_in_one_command_however_often_it_is_killed(
    run, collection, tmp_path, monkeypatch, prior
):
    """Killed while the dataset is built, while it trains and while it is scored."""
    output = tmp_path / "out"
    command = ("train", "--meshes", collection, "--name", "box", "--output", output, *TINY)
    whole, trained = training.train, []

    def train(folder, data, config, start=None):
        trained.append(data.names)
        return whole(folder, data, config, start)

    monkeypatch.setattr(training, "train", train)
    for module, name in STAGES:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, name, killed_after(getattr(module, name), 1))
            status, _, err = run(*command)
        assert status == 2 and "killed" in err, err
        assert not (output / "box.md").exists()
    status, out, err = run(*command)
    assert status == 0, err
    sources = list_meshes(collection)
    training_set, held_out = (
        {source.name for source in part}
        for part in hold_out([look(source, up="y", front="z", unit="m") for source in sources])
    )
    assert trained == 3 * [sorted(training_set - {"empty"})]
    content = json.loads((output / "evaluation.json").read_text())
    assert {scores["name"] for scores in content["per_mesh"]} == held_out - {"empty"}
    assert list(content["means"]) == ["1", "4", "8", "18"]
    assert list(content["means"]["1"]) == ["encoder", "cma", "bounds"]
    assert fingerprint(load_prior(output / "box.safetensors"))
    card = load_card(output / "box.safetensors")
    assert card == json.loads((output / "card.json").read_text())
    assert card["samples"] == 8 and card["training_loss"] == 0.4 and card["training_seconds"] == 8
    assert "| 18 | cma | 0.500 |" in (output / "box.md").read_text()
    assert "cma" in out and "box.safetensors" in out
    assert {path.name for path in output.iterdir()} == {
        "box.safetensors", "box.md", "card.json", "dataset", "evaluation.json", "metrics.jsonl"
    }  # fmt: skip


def test_training_goes_on_from_the_weights_of_another(
    run, collection, tmp_path, monkeypatch, prior
):
    given = []
    whole = training.train

    def train(folder, data, config, start=None):
        given.append(start)
        return whole(folder, data, config, start)

    monkeypatch.setattr(training, "train", train)
    first = tmp_path / "first.safetensors"
    save_prior(first, prior, {"samples": 100, "samples_before": 20})
    command = ("train", "--meshes", collection, "--start", first, *TINY)
    assert run(*command, "--licence", "CC0", "--output", tmp_path / "out")[0] == 0
    assert fingerprint(given[0]) == fingerprint(load_prior(first))
    card = load_card(tmp_path / "out" / "weights.safetensors")
    assert (card["samples_before"], card["samples"]) == (120, 8)
    assert card["start"] == fingerprint(load_prior(first)) and card["licence"] == "CC0"
    text = (tmp_path / "out" / "weights.md").read_text()
    assert "after 120 samples" in text and "| Licence | CC0 |" in text


@pytest.mark.slow
def test_from_dataset_to_training_to_reconstruction(run, chair, tmp_path):
    data, trained = tmp_path / "data", tmp_path / "train"
    make = ("dataset", "--count", 4, "--frames", 1, 2, "--cameras", "paper", "--workers", 1,
            "--output", data)  # fmt: skip
    learn = ("train", "--dataset", data, "--output", trained, "--steps", 2, "--batch", 2)
    few = ("--weights", trained / "weights.safetensors", "--iterations", 2)
    for command in (
        make,
        (*learn, *SIZES),
        ("evaluate", "--meshes", chair, "--frames", "1", "--output", tmp_path / "s.json", *few),
    ):
        status, _, err = run(*command)
        assert status == 0, err
    assert json.loads((trained / "card.json").read_text())["samples"] == 4
    assert set(json.loads((tmp_path / "s.json").read_text())["means"]) == {"1"}
    # An untrained decoder may call every voxel free, which leaves no surface to write.
    status, out, err = run("demo", "--frames", 2, "--output", tmp_path / "demo", *few)
    assert status == 0, err
    result = json.loads((tmp_path / "demo" / "result.json").read_text())
    assert {"iou_encoder", "iou_refined", "iou_composed", "seconds"} <= set(result)


@pytest.mark.slow
def test_from_meshes_to_scored_weights(run, tmp_path):
    """Own category with nothing replaced; asked for again, it has nothing left to train."""
    (tmp_path / "boxes").mkdir()
    for i in range(12):
        trimesh.creation.box((1, 1 + i / 10, 2)).export(tmp_path / "boxes" / f"{i}.ply")
    command = ("train", "--meshes", tmp_path / "boxes", "--name", "box", *TINY)
    outcomes = []
    for _ in range(2):
        status, out, err = run(*command, "--output", tmp_path / "out")
        assert status == 0, err
        trained = tmp_path / "out" / "box.safetensors"
        metrics = (tmp_path / "out" / "metrics.jsonl").read_text()
        outcomes.append((fingerprint(load_prior(trained)), load_card(trained), metrics, out))
    assert outcomes[0] == outcomes[1]
    means = json.loads((tmp_path / "out" / "evaluation.json").read_text())["means"]
    assert 0 <= means["4"]["cma"]["iou"] <= 1
