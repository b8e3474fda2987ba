"""Tests of convert.py on files that zarr and pyarrow themselves wrote."""

import json
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
import zarr
from conftest import fails

import convert
from data import Demonstrations, load_demonstrations, save_demonstrations

pytestmark = pytest.mark.usefixtures("own_folder")
RNG = np.random.default_rng(0)
PICKLE = {"id": "pickle"}
SAY = ["--instruction", "Stir the soup."]


# ---- Pictures ------------------------------------------------------------------------------------


def test_show_draws_a_picture_of_an_episode_that_there_is(capsys):
    points = RNG.uniform(0.1, 1, (12, 16, 3)).astype(np.float16)
    state, action = np.zeros((12, 9), np.float32), np.zeros((12, 4), np.float32)
    ends = np.array([7, 12])
    recording = Demonstrations("reach", "Move.", points, state, action, ends, meta={})
    save_demonstrations("reach.npz", recording)
    convert.main(["--show", "reach.npz", "--episode", "1"])
    assert Path("reach.png").stat().st_size > 10_000
    assert "reach.png" in capsys.readouterr().out
    message = fails(convert, ["--show", "reach.npz", "--episode", "2"], capsys)
    assert "reach.npz: holds episodes 0 to 1, not 2" in message


def test_the_script_itself_ends_in_one_line_where_a_file_is_missing():
    command = [sys.executable, convert.__file__, "--show", "nothing.npz"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2 and ended.stderr.startswith("error: nothing.npz is missing")


# ---- DP3's zarr ----------------------------------------------------------------------------------


def buffer(path, zarr_format=2, **changes):
    """A replay buffer of two episodes, 8 and 12 frames; colours stand beside the points."""
    arrays = {
        "data/point_cloud": RNG.uniform(0, 1, (20, 30, 6)).astype(np.float32),
        "data/state": RNG.normal(size=(20, 7)),
        "data/action": RNG.normal(size=(20, 4)).astype(np.float32),
        "meta/episode_ends": np.array([8, 20]),
    } | {name.replace("__", "/"): value for name, value in changes.items()}
    group = zarr.open_group(path, mode="w", zarr_format=zarr_format)
    for name, value in arrays.items():
        if value is not None:
            group.create_array(name, data=value)
    return arrays


@pytest.mark.parametrize("zarr_format, zipped", [(2, False), (3, False), (2, True)])
def test_a_replay_buffer_becomes_a_recording(zarr_format, zipped, capsys):
    arrays, path = buffer("stir.zarr", zarr_format), "stir.zarr"
    if zipped:
        path = shutil.make_archive("stir", "zip", "stir.zarr")
    argv = "--task stir --num-points 16 --positions-in-state 1".split()
    convert.main(["--import", path, *SAY, *argv])
    assert "wrote recordings/stir.npz: 2 episodes" in capsys.readouterr().out
    found = load_demonstrations("recordings/stir.npz")
    assert (found.task, found.instruction) == ("stir", "Stir the soup.")
    np.testing.assert_array_equal(found.episode_ends, arrays["meta/episode_ends"])
    np.testing.assert_allclose(found.state, arrays["data/state"], rtol=1e-6)
    np.testing.assert_array_equal(found.action, arrays["data/action"])
    assert found.points.shape == (20, 16, 3) and found.meta["positions_in_state"] == 1
    for few, all_points in zip(found.points, arrays["data/point_cloud"][..., :3]):
        known = {tuple(p) for p in all_points.astype(np.float16)}
        assert len({tuple(p) for p in few} & known) == 16
    assert "already exists" in fails(convert, ["--import", path, *SAY, *argv], capsys)


@pytest.mark.parametrize(
    "change, options, message",
    [
        ({}, [], 'does not say what is done: add --instruction "Stir the soup."'),
        ({"data__point_cloud": None}, SAY, "it lacks data/point_cloud"),
        ({"meta__episode_ends": None}, SAY, "it lacks meta/episode_ends"),
        ({"data__point_cloud": np.zeros((20, 30, 2))}, SAY, "must be (frames, points, 3)"),
        ({"data__point_cloud": np.zeros((20, 30, 3))}, SAY, "all points of frame 0 are at 0, 0, 0"),
        ({"data__state": np.full(20, "x")}, SAY, "data/state must be plain numbers"),
        ({"data__action": np.zeros((19, 4))}, SAY, "lengths differ"),
        ({"meta__episode_ends": np.array([8, 21])}, SAY, "lengths differ"),
        ({"meta__episode_ends": np.array([8.0, 20.0])}, SAY, "growing whole numbers"),
        ({}, [*SAY, "--task", "../evil"], "is no name"),
        ({}, [*SAY, "--positions-in-state", "3"], "positions_in_state is 3"),
        ({}, [*SAY, "--num-points", "0"], "--num-points is 0: use at least 1"),
    ],
)
@pytest.mark.filterwarnings("ignore")  # zarr's, of text
def test_a_wrong_buffer_is_refused_in_one_line(change, options, message, capsys):
    buffer("stir.zarr", 3, **change)
    assert message in fails(convert, ["--import", "stir.zarr", *options], capsys)
    assert not Path("recordings").exists()


def test_what_is_no_zarr_is_refused_in_one_line(capsys, monkeypatch):
    Path("empty").mkdir()
    Path("file").write_text("text")
    for path in ("empty", "file"):
        message = fails(convert, ["--import", path, *SAY], capsys)
        assert "damaged or neither zarr nor a dataset of LeRobot" in message
    assert "is missing" in fails(convert, ["--import", "nothing", *SAY], capsys)
    monkeypatch.setitem(sys.modules, "zarr", None)
    assert "pip install zarr" in fails(convert, ["--import", "empty", *SAY], capsys)


class Bomb:
    def __reduce__(self):
        return (Path.touch, (Path("exploded"),))


@pytest.mark.parametrize("dtype", ["<f8", "|O"])
@pytest.mark.parametrize("codec", [{"compressor": PICKLE}, {"filters": [PICKLE]}])
def test_nothing_is_unpickled(codec, dtype, capsys):
    buffer("stir.zarr")
    described = Path("stir.zarr/data/state/.zarray")
    about = json.loads(described.read_text()) | {"compressor": None, "dtype": dtype}
    described.write_text(json.dumps(about | codec))
    for chunk in described.parent.glob("[0-9]*"):
        chunk.write_bytes(pickle.dumps(Bomb()))
    assert "stir.zarr" in fails(convert, ["--import", "stir.zarr", *SAY], capsys)
    assert not Path("exploded").exists()


# ---- LeRobot -------------------------------------------------------------------------------------


def dataset(path, version="v3.0", seen="observation.point_cloud", shape=(30, 3), **more):
    """A dataset as lerobot 0.4.4 writes it: three episodes, the second of another task."""
    path = Path(path)
    values = {
        "observation.state": RNG.normal(size=(20, 7)).astype(np.float32),
        "action": RNG.normal(size=(20, 4)).astype(np.float32),
        seen: RNG.uniform(0, 1, (20, *shape)).astype(np.float32),
    } | more
    episode = np.repeat([0, 1, 2], [8, 5, 7])
    values |= {"episode_index": episode, "task_index": np.array([0, 1, 0])[episode]}
    features = {
        name: {"dtype": str(x.dtype), "shape": list(x.shape[1:]) or [1], "names": None}
        for name, x in values.items()
    }
    features |= {"observation.images.top": {"dtype": "video", "shape": [3, 48, 64]}}
    info = {"codebase_version": version, "total_frames": 20, "features": features}
    for folder in ("meta", "data/chunk-000"):
        (path / folder).mkdir(parents=True)
    (path / "meta/info.json").write_text(json.dumps(info))

    said = ["Stir the soup.", "Pour the tea."]
    if version == "v3.0":
        table = {"task_index": [0, 1], "__index_level_0__": said}
        pyarrow.parquet.write_table(pyarrow.table(table), path / "meta/tasks.parquet")
        files = {"file-000": slice(0, 20)}
    else:
        lines = [json.dumps({"task_index": i, "task": task}) for i, task in enumerate(said)]
        (path / "meta/tasks.jsonl").write_text("\n".join(lines))
        files = {f"episode_{e:06d}": episode == e for e in range(3)}
    for name, rows in files.items():
        table = pyarrow.table({key: x[rows].tolist() for key, x in values.items()})
        pyarrow.parquet.write_table(table, path / f"data/chunk-000/{name}.parquet")
    return values


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_a_dataset_becomes_a_recording_a_task(version, capsys):
    values = dataset("kitchen", version)
    convert.main("--import kitchen --num-points 16 --out own".split())
    assert sorted(path.name for path in Path("own").iterdir()) == [
        "pour-the-tea.npz",
        "stir-the-soup.npz",
    ]
    for name, task, ends in (("stir-the-soup", 0, [8, 15]), ("pour-the-tea", 1, [5])):
        found = load_demonstrations(f"own/{name}.npz")
        rows = values["task_index"] == task
        assert found.instruction.lower().startswith(name[:4]) and found.task == name
        assert found.episode_ends.tolist() == ends
        np.testing.assert_array_equal(found.state, values["observation.state"][rows])
        np.testing.assert_array_equal(found.action, values["action"][rows])
        cloud = {tuple(p) for p in np.float16(values["observation.point_cloud"][rows][-1])}
        assert found.points.shape[1:] == (16, 3) and {tuple(p) for p in found.points[-1]} <= cloud


LENS = [40.0, 50.0, 8.0, 6.0]
MATRIX = [[40.0, 0, 8.0], [0, 50.0, 6.0], [0, 0, 1]]
POSE = [[0, -1, 0, 0.5], [1, 0, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]]


@pytest.mark.parametrize("given", ["file", "four", "matrix"])
def test_depth_becomes_points_where_its_pixels_look(given):
    depth = np.zeros((20, 12, 16), np.uint16)
    depth[:, 3, 10] = 2000 + np.arange(20)  # millimetres
    more = {"observation.depth": depth}
    if given != "file":
        lens = np.array(LENS if given == "four" else MATRIX, np.float32)
        more["observation.intrinsics"] = np.broadcast_to(lens, (20, *lens.shape))
    dataset("kitchen", seen="observation.depth", **more)
    camera = {"camera_to_base": POSE} | ({"intrinsics": LENS} if given == "file" else {})
    Path("camera.json").write_text(json.dumps(camera))
    convert.main("--import kitchen --num-points 2 --camera camera.json".split())
    found = load_demonstrations("recordings/pour-the-tea.npz").points.astype(np.float64)
    z = (2000 + np.arange(8, 13)) / 1000
    x, y = (10 - 8) / 40 * z, (3 - 6) / 50 * z
    expected = np.stack([0.5 - y, x, z + 0.1], axis=-1)
    np.testing.assert_allclose(found[:, 0], expected, atol=2e-3)


def edit(**changes):
    """Changes what meta/info.json says."""
    path = Path("kitchen/meta/info.json")
    info = json.loads(path.read_text())
    path.write_text(json.dumps(info | {k: f(info.get(k)) for k, f in changes.items()}))


def without(name):
    return lambda: edit(features=lambda old: {k: f for k, f in old.items() if k != name})


@pytest.mark.parametrize(
    "damage, options, message",
    [
        (without("action"), "", "it lacks action; it holds observation.state"),
        (without("observation.point_cloud"), "", "with --feature; it holds observation.state"),
        (lambda: None, "--feature observation.images.top", "observation.images.top (video)"),
        (lambda: edit(codebase_version=lambda _: "v1.6"), "", "format v1.6: convert it to v3.0"),
        (lambda: Path("kitchen/meta/info.json").write_text("{"), "", "is no JSON object"),
        (lambda: shutil.rmtree("kitchen/data"), "", "holds no frames"),
        (lambda: None, "--feature observation.state", "with --feature; it holds"),
        (lambda: None, "--task stir", "holds 2 tasks"),
        (lambda: None, "--instruction Stir.", "leave --instruction out"),
    ],
)
def test_a_wrong_dataset_is_refused_in_one_line(damage, options, message, capsys):
    dataset("kitchen")
    damage()
    assert message in fails(convert, ["--import", "kitchen", *options.split()], capsys)
    assert not Path("recordings").exists()


@pytest.mark.parametrize(
    "camera, message",
    [
        ({"camera_to_bse": POSE}, "camera_to_bse is none of intrinsics, camera_to_base"),
        ({"intrinsics": 600}, "intrinsics: give 4 of float or int"),
        ({"intrinsics": ["600"] * 4}, "intrinsics: give 4 of float or int"),
        ({"crop_low_m": [0, 0, float("nan")]}, "crop_low_m: use"),
        ({"intrinsics": LENS, "camera_to_base": MATRIX}, "camera_to_base: give 4 x 4 of float"),
        ({"camera_to_base": [[-1, 0, 0, 0], *np.eye(4).tolist()[1:]]}, "camera_to_base: its 3 x 3"),
        ({"intrinsics": [-50.0, *LENS[1:]]}, "intrinsics: two focal lengths in pixels"),
    ],
)
def test_a_wrong_camera_is_refused_in_one_line(camera, message, capsys):
    dataset("kitchen", seen="observation.depth", shape=(12, 16))
    Path("camera.json").write_text(json.dumps(camera))
    argv = "--import kitchen --camera camera.json".split()
    assert f"camera.json: {message}" in fails(convert, argv, capsys)


def test_of_two_lenses_none_is_guessed_and_the_file_of_the_camera_comes_first(capsys):
    depth = np.full((20, 12, 16), 2000, np.uint16)
    lenses = {f"{side}.intrinsics": np.tile(np.float32(LENS), (20, 1)) for side in ("left", "top")}
    dataset("kitchen", seen="observation.depth", **{"observation.depth": depth}, **lenses)
    message = fails(convert, ["--import", "kitchen"], capsys)
    assert "has the lenses left.intrinsics, top.intrinsics" in message
    Path("camera.json").write_text(json.dumps({"intrinsics": [80.0, 50.0, 8.0, 6.0]}))
    convert.main("--import kitchen --num-points 192 --camera camera.json".split())
    found = load_demonstrations("recordings/pour-the-tea.npz").points
    assert found[..., 0].max() == pytest.approx((15 - 8) / 80 * 2, abs=1e-3)


def test_depth_without_intrinsics_says_where_to_write_them(capsys, monkeypatch):
    dataset("kitchen", seen="observation.depth", shape=(12, 16))
    message = fails(convert, ["--import", "kitchen"], capsys)
    assert "observation.depth needs the camera's fx, fy, cx, cy: write them to --camera" in message
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    assert "pip install pyarrow" in fails(convert, ["--import", "kitchen"], capsys)
