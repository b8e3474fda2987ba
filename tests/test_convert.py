"""Tests of convert.py on files that zarr, pyarrow, h5py and PyAV themselves wrote."""

import io
import json
import os
import pickle
import shutil
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import av
import h5py
import numpy as np
import PIL.Image
import pyarrow
import pyarrow.parquet
import pytest
import rlbench_standin as standin
import zarr
from conftest import fails

import convert
from data import Demonstrations, RecordingError, load_demonstrations, save_demonstrations

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
    message = fails(convert, ["--show", "reach.npz", "--out", "reach.v2"], capsys)
    assert "--out is reach.v2: name a .png file" in message
    assert ". is a folder: name one of the" in fails(convert, ["--show", "."], capsys)
    assert "neither zarr, HDF5" in fails(convert, ["--import", ""], capsys)  # an unset variable
    message = fails(convert, ["--show", "nothing.npz", "--out", "nowhere/reach.png"], capsys)
    assert "--out is nowhere/reach.png: its folder does not exist" in message


def test_the_script_itself_ends_in_one_line_where_a_file_is_missing():
    command = [sys.executable, convert.__file__, "--show", "nothing.npz"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2 and ended.stderr.startswith("error: nothing.npz is missing")


def hand(path, task="reach", **changes):
    """A file of a hand that is moved through a cloud, two episodes of 20 frames."""
    action = RNG.normal(scale=0.01, size=(2, 20, 3))
    state = np.concatenate([np.zeros((2, 1, 3)), action.cumsum(axis=1)[:, :-1]], axis=1)
    arrays = {
        "points": RNG.uniform(-0.5, 0.5, (40, 16, 3)).astype(np.float16),
        "state": state.reshape(40, 3).astype(np.float32),
        "action": action.reshape(40, 3).astype(np.float32),
        "episode_ends": np.array([20, 40]),
        "meta": {"positions_in_state": 1},
    }
    save_demonstrations(path, Demonstrations(task, "Move.", **{**arrays, **changes}))
    return arrays


def test_checking_a_folder_says_what_looks_wrong_and_in_which_file(capsys, monkeypatch):
    arrays = hand("own/good.npz")
    convert.main(["--check", "own"])
    assert capsys.readouterr().out == "files checked: 1, suspicions: 0\n"
    hand("own/wrong.npz", state=1000 * arrays["state"])
    convert.main(["--check", "own"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("own/wrong.npz: position 0 of the state lies far from the points")
    assert lines[1:] == ["files checked: 2, suspicions: 1"]
    monkeypatch.setattr(convert, "plot_demonstration", lambda *_: None)
    convert.main(["--show", "own/wrong.npz"])
    assert lines[0].split(" (")[0] in capsys.readouterr().out


def test_an_error_of_a_file_that_is_checked_stays_an_error(capsys):
    hand("own/reach.npz")
    Path("own/torn.npz").write_bytes(Path("own/reach.npz").read_bytes()[:1000])
    assert "own/torn.npz is truncated" in fails(convert, ["--check", "own"], capsys)
    Path("empty").mkdir()
    assert "empty: holds no recordings" in fails(convert, ["--check", "empty"], capsys)


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


@pytest.mark.parametrize(
    "zarr_format, zipped", [(2, None), (3, None), (2, "inside"), (2, "folder"), (3, "folder")]
)
def test_a_replay_buffer_becomes_a_recording(zarr_format, zipped, capsys):
    arrays, path = buffer("stir.zarr", zarr_format), "stir.zarr"
    if zipped == "inside":
        path = shutil.make_archive("stir", "zip", "stir.zarr")
    if zipped == "folder":
        path = shutil.make_archive("stir", "zip", base_dir="stir.zarr")
    argv = "--task stir --num-points 16 --positions-in-state 1".split()
    convert.main(["--import", path, *SAY, *argv])
    printed = capsys.readouterr().out
    assert "wrote recordings/stir.npz: 2 episodes" in printed
    assert "left out: 3 numbers beside x, y, z of each point (--color keeps colors)" in printed
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
    "options, message",
    [
        ("--task ../evil", "--task '../evil': use letters, digits"),
        ("--task stir --out stir.npz", "--out is stir.npz: name a folder, in which each task"),
        ("--out file", "--out is file: name a folder, in which each task"),
        ("--out file/recordings", "--out is file/recordings: name a folder"),
    ],
)
def test_names_that_nothing_could_be_written_to_are_refused_before_anything_is_read(
    options, message, capsys, monkeypatch
):
    buffer("stir.zarr")
    Path("file").touch()
    monkeypatch.setattr(convert, "reader_of", None)
    assert message in fails(convert, ["--import", "stir.zarr", *SAY, *options.split()], capsys)


EMPTY = np.full((20, 30, 3), np.nan)
FAR = 90 + RNG.uniform(0, 0.1, (20, 30, 3))


@pytest.mark.parametrize(
    "change, options, message",
    [
        ({}, [], 'does not say what is done: add --instruction "Stir the soup."'),
        ({"data__point_cloud": None}, SAY, "it lacks data/point_cloud"),
        ({"meta__episode_ends": None}, SAY, "it lacks meta/episode_ends"),
        ({"data__point_cloud": np.ones((20, 30, 2))}, SAY, "(30, 2) is neither (points, 3 to 10)"),
        ({"data__point_cloud": np.ones((20, 8, 6))}, SAY, "(8, 6) is neither (points, 3 to 10)"),
        (
            {"data__point_cloud": np.zeros((20, 30, 3))},
            SAY,
            "1 of 1 chunks of data/point_cloud are",
        ),
        ({"data__point_cloud": EMPTY}, SAY, "nothing is seen in 8 of 8 frames of episode 0"),
        (
            {"data__point_cloud": np.full((20, 30, 3), 900.0)},
            SAY,
            "points reach 900, beyond 100 me",
        ),
        ({"data__point_cloud": FAR}, SAY, "90.1 m from the origin, but span 0.0999 m"),
        ({"data__state": np.full((20, 7), np.nan)}, SAY, "state of episode 0 holds NaN"),
        ({"data__state": np.full(20, "x")}, SAY, "data/state must be plain numbers"),
        ({"data__state": np.array(3.0)}, SAY, "data/state must be plain numbers"),
        ({}, [*SAY, "--skip", "0", "1"], "stir.zarr: --skip leaves no episode of it"),
        ({}, [*SAY, "--feature", "data/wrist"], "DP3, for which --feature has no meaning"),
        ({}, [*SAY, "--state", "data/state"], "for which --state has no meaning: leave it out"),
        ({"data__action": np.zeros((19, 4))}, SAY, "lengths differ"),
        ({"meta__episode_ends": np.array([8, 21])}, SAY, "lengths differ"),
        ({"meta__episode_ends": np.array([8.0, 20.0])}, SAY, "growing whole numbers"),
        ({}, [*SAY, "--positions-in-state", "3"], "positions_in_state is 3"),
        ({}, [*SAY, "--num-points", "0"], "--num-points is 0: use at least 1"),
    ],
)
@pytest.mark.filterwarnings("ignore")  # zarr's, of text
def test_a_wrong_buffer_is_refused_in_one_line(change, options, message, capsys):
    buffer("stir.zarr", 3, **change)
    assert message in fails(convert, ["--import", "stir.zarr", *options], capsys)
    assert not Path("recordings").exists()


def clouds_of(arrays):
    """What `buffer` wrote, as sets of points."""
    return [{tuple(p) for p in cloud} for cloud in arrays["data/point_cloud"].astype(np.float16)]


@pytest.mark.parametrize("shape", ["channels first", "image"])
def test_the_axes_of_a_cloud_are_told_apart(shape):
    cloud = RNG.uniform(0, 1, (20, 30, 3)).astype(np.float32)
    stored = np.moveaxis(cloud, 1, 2) if shape == "channels first" else cloud.reshape(20, 5, 6, 3)
    buffer("stir.zarr", data__point_cloud=stored)
    convert.main(["--import", "stir.zarr", *SAY, "--num-points", "30"])
    found = load_demonstrations("recordings/stir-the-soup.npz").points
    for points, expected in zip(found, clouds_of({"data/point_cloud": cloud})):
        assert {tuple(p) for p in points} == expected


def test_points_that_were_not_seen_are_left_out_and_counted(capsys):
    cloud = RNG.uniform(0.1, 1, (20, 30, 3)).astype(np.float32)
    cloud[3, 4] = np.nan
    cloud[5, :2] = 0
    cloud[7] = np.nan  # nothing at all is seen in this frame
    buffer("stir.zarr", data__point_cloud=cloud)
    convert.main(["--import", "stir.zarr", *SAY, "--num-points", "30"])
    printed = capsys.readouterr().out
    assert (
        "left out: 33 points at NaN or at the origin; 1 empty clouds, in whose place stands"
        in printed
    )
    points = load_demonstrations("recordings/stir-the-soup.npz").points
    assert np.isfinite(points).all() and (points != 0).any(axis=-1).all()
    np.testing.assert_array_equal(points[7], points[6])


@pytest.mark.parametrize("largest", [1, 255])
def test_colors_are_kept_from_0_to_1(largest, capsys):
    cloud = RNG.uniform(0, 1, (20, 30, 6)).astype(np.float32)
    cloud[..., 3:] *= largest
    buffer("stir.zarr", data__point_cloud=cloud)
    convert.main(["--import", "stir.zarr", *SAY, "--num-points", "30", "--color"])
    assert capsys.readouterr().out.endswith("left out: nothing\n")
    found = load_demonstrations("recordings/stir-the-soup.npz").points
    stored = cloud / np.array([1, 1, 1, largest, largest, largest])
    distance = np.linalg.norm(found[9][:, None, :3] - stored[9][None, :, :3], axis=-1)
    np.testing.assert_allclose(found[9], stored[9][distance.argmin(axis=1)], atol=1e-3)


@pytest.mark.parametrize(
    "cloud, message",
    [
        (RNG.normal(size=(20, 30, 6)), "where colors reach from 0 to 1 or 255: leave --color out"),
        (RNG.normal(size=(20, 30, 3)), "have 3 numbers, so no color: leave --color out"),
    ],
)
def test_what_is_no_color_is_not_kept_as_one(cloud, message, capsys):
    buffer("stir.zarr", data__point_cloud=cloud)
    assert message in fails(convert, ["--import", "stir.zarr", *SAY, "--color"], capsys)


def test_a_name_of_a_color_that_is_not_read_is_refused(capsys):
    buffer("stir.zarr", data__point_cloud=RNG.uniform(0, 1, (20, 30, 6)).astype(np.float32))
    message = fails(convert, ["--import", "stir.zarr", *SAY, "--color", "data/img"], capsys)
    assert "write --color alone if the points have six numbers, or leave it out" in message


def test_an_episode_can_be_left_out(capsys):
    state = RNG.normal(size=(20, 7))
    state[3, 2] = np.inf
    arrays = buffer("stir.zarr", data__state=state)
    message = fails(convert, ["--import", "stir.zarr", *SAY], capsys)
    assert "state of episode 0 holds NaN or infinity in frame 3: leave" in message
    convert.main(["--import", "stir.zarr", *SAY, *message.split("by ")[1].split()])
    assert "episode 0 (--skip)" in capsys.readouterr().out
    found = load_demonstrations("recordings/stir-the-soup.npz")
    np.testing.assert_array_equal(found.action, arrays["data/action"][8:])


def test_an_episode_to_be_left_out_must_be_there(capsys):
    buffer("stir.zarr")
    message = fails(convert, ["--import", "stir.zarr", *SAY, "--skip", "2"], capsys)
    assert "stir.zarr: has no episode 2 to --skip" in message


def test_the_colors_of_a_frame_that_stands_for_another_are_scaled_once():
    cloud = RNG.uniform(1, 200, (20, 30, 6)).astype(np.float32)
    cloud[..., :3] /= 200
    cloud[7] = np.nan
    buffer("stir.zarr", data__point_cloud=cloud)
    convert.main(["--import", "stir.zarr", *SAY, "--color"])
    points = load_demonstrations("recordings/stir-the-soup.npz").points
    np.testing.assert_array_equal(points[7], points[6])


def test_a_missing_chunk_is_not_read_as_zeros(capsys):
    buffer("stir.zarr")
    os.remove(next(Path("stir.zarr/data/state").glob("[0-9]*")))
    message = fails(convert, ["--import", "stir.zarr", *SAY], capsys)
    assert "1 of 1 chunks of data/state are missing" in message


def test_a_pointer_of_git_lfs_is_named(capsys):
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 123\n"
    Path("stir.zip").write_text(pointer)
    message = fails(convert, ["--import", "stir.zip", *SAY], capsys)
    assert "stir.zip: is a pointer of git-lfs, not the file itself" in message
    Path("demo.hdf5").write_text(pointer)
    message = fails(convert, ["--import", "demo.hdf5", *SAY], capsys)
    assert "demo.hdf5: is a pointer of git-lfs" in message


def test_what_is_no_zarr_is_refused_in_one_line(capsys, monkeypatch):
    Path("empty").mkdir()
    Path("file").write_text("text")
    for path in ("empty", "file"):
        message = fails(convert, ["--import", path, *SAY], capsys)
        assert "damaged or neither zarr, HDF5 nor a dataset of LeRobot" in message
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
    description = json.loads(described.read_text())
    description.update(compressor=None, dtype=dtype)
    description.update(codec)
    described.write_text(json.dumps(description))
    for chunk in described.parent.glob("[0-9]*"):
        chunk.write_bytes(pickle.dumps(Bomb()))
    assert "stir.zarr" in fails(convert, ["--import", "stir.zarr", *SAY], capsys)
    assert not Path("exploded").exists()


# ---- LeRobot -------------------------------------------------------------------------------------


LENGTHS = [8, 5, 7]  # frames of the episodes; the second does another task


def dataset(path, version="v3.0", seen="observation.point_cloud", shape=(30, 3), info=None, **more):
    """A dataset as lerobot writes it; `info` is what it says about the feature `seen`.

    A picture is a list of bytes, a video a list of arrays; see `write_videos`.
    """
    path = Path(path)
    episode = np.repeat(np.arange(3), LENGTHS)
    index = np.concatenate([np.arange(length) for length in LENGTHS])
    values = {
        "observation.state": RNG.normal(size=(20, 7)).astype(np.float32),
        "action": RNG.normal(size=(20, 4)).astype(np.float32),
        seen: RNG.uniform(0, 1, (20, *shape)).astype(np.float32),
        "episode_index": episode,
        "task_index": np.array([0, 1, 0])[episode],
        "frame_index": index,
        "timestamp": (index / 10).astype(np.float32),
    } | more
    features = {}
    for name, x in values.items():
        is_picture = isinstance(x, list)
        dtype = "image" if is_picture else str(x.dtype)
        shape = [12, 16, 1] if is_picture else list(x.shape[1:]) or [1]
        features[name] = {"dtype": dtype, "shape": shape, "names": None}
    features[seen]["info"] = info
    features["observation.images.top"] = {"dtype": "video", "shape": [3, 48, 64]}
    information = {
        "codebase_version": version,
        "total_frames": 20,
        "total_episodes": 3,
        "fps": 10,
        "features": features,
    }
    for folder in ("meta/episodes/chunk-000", "data/chunk-000"):
        (path / folder).mkdir(parents=True)
    (path / "meta/info.json").write_text(json.dumps(information))

    instructions = ["Stir the soup.", "Pour the tea."]
    if version == "v3.0":
        table = {"task_index": [0, 1], "__index_level_0__": instructions}
        pyarrow.parquet.write_table(pyarrow.table(table), path / "meta/tasks.parquet")
        table = {"episode_index": [0, 1, 2], "length": LENGTHS}
        write_table(table, path / "meta/episodes/chunk-000/file-000.parquet")
        files = {"file-000": slice(0, 20)}
    else:
        lines = [json.dumps({"task_index": i, "task": task}) for i, task in enumerate(instructions)]
        (path / "meta/tasks.jsonl").write_text("\n".join(lines))
        lines = [json.dumps({"episode_index": e, "length": n}) for e, n in enumerate(LENGTHS)]
        (path / "meta/episodes.jsonl").write_text("\n".join(lines))
        files = {f"episode_{e:06d}": episode == e for e in range(3)}
    for name, rows in files.items():
        table = {}
        for key, x in values.items():
            table[key] = [{"bytes": b} for b in x] if isinstance(x, list) else x[rows].tolist()
        write_table(table, path / f"data/chunk-000/{name}.parquet")
    return values


def write_table(columns, path):
    pyarrow.parquet.write_table(pyarrow.table(columns), path)


def rewrite(path, rows=None, **changes):
    """Keeps some rows of a parquet file, and changes columns, each by a function of its values."""
    table = pyarrow.parquet.read_table(path)
    table = table if rows is None else table.take(list(rows))
    columns = table.to_pydict()
    for name, change in changes.items():
        columns[name] = change(columns[name])
    write_table(columns, path)


@pytest.mark.parametrize("version", ["v2.0", "v2.1", "v3.0"])
def test_a_dataset_becomes_a_recording_a_task(version, capsys):
    values = dataset("kitchen", version)
    convert.main("--import kitchen --num-points 16 --out own".split())
    assert capsys.readouterr().out.count("left out: 1 arrays (observation.images.top)\n") == 2
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


def test_an_episode_of_an_older_dataset_must_be_as_long_as_it_says(capsys):
    dataset("kitchen", "v2.1")
    rewrite("kitchen/data/chunk-000/episode_000002.parquet", rows=range(5))
    message = fails(convert, "--import kitchen --num-points 16 --out own".split(), capsys)
    assert "episode 2 should have 7 frames, but has 5" in message


LENS = [40.0, 50.0, 8.0, 6.0]
MATRIX = [[40.0, 0, 8.0], [0, 50.0, 6.0], [0, 0, 1]]
POSE = [[0, -1, 0, 0.5], [1, 0, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]]
DEPTH = "observation.depth"
MILLIMETRES = {"depth_unit": "mm"}


def one_pixel(values, dtype=np.uint16):
    """Depth images (20, 12, 16) in which one pixel is not 0."""
    depth = np.zeros((20, 12, 16), dtype)
    depth[:, 3, 10] = values
    return depth


def seen_in_one_pixel(metres):
    """Where the points of `one_pixel` are in the frame of the camera."""
    return np.stack([(10 - 8) / 40 * metres, (3 - 6) / 50 * metres, metres], axis=-1)


@pytest.mark.parametrize("given", ["file", "four", "matrix"])
def test_depth_becomes_points_where_its_pixels_look(given):
    more = {DEPTH: one_pixel(2000 + np.arange(20))}
    if given != "file":
        lens = np.array(LENS if given == "four" else MATRIX, np.float32)
        more["observation.intrinsics"] = np.broadcast_to(lens, (20, *lens.shape))
    dataset("kitchen", seen=DEPTH, info=MILLIMETRES, **more)
    camera = {"camera_to_base": POSE} | ({"intrinsics": LENS} if given == "file" else {})
    Path("camera.json").write_text(json.dumps(camera))
    convert.main("--import kitchen --num-points 2 --camera camera.json".split())
    found = load_demonstrations("recordings/pour-the-tea.npz").points.astype(np.float64)
    x, y, z = seen_in_one_pixel((2000 + np.arange(8, 13)) / 1000).T
    expected = np.stack([0.5 - y, x, z + 0.1], axis=-1)
    np.testing.assert_allclose(found[:, 0], expected, atol=2e-3)


@pytest.mark.parametrize(
    "stored, info, camera, options, metres",
    [
        (np.full(20, 700, np.uint16), MILLIMETRES, {}, "", 0.7),
        (np.full(20, 700, np.float32), MILLIMETRES, {}, "", 0.7),
        (np.full(20, 7, np.uint16), {"depth_unit": "m"}, {}, "", 7),
        (np.full(20, 7000, np.uint16), None, {"depth_scale": 0.0001}, "", 0.7),
        (np.full(20, 7000, np.uint16), MILLIMETRES, {"depth_scale": 0.0001}, "", 0.7),
        (np.full(20, 7000, np.uint16), None, {}, "--depth-unit 0.0001", 0.7),
        (np.full(20, 700, np.float64), None, {}, "--depth-unit mm", 0.7),
        (np.full(20, 0.7), None, {}, "--depth-unit m", 0.7),
    ],
)
def test_the_unit_of_depth_is_said_and_not_taken_from_its_type(
    stored, info, camera, options, metres
):
    depth = {DEPTH: one_pixel(stored, stored.dtype)}
    dataset("kitchen", seen=DEPTH, info=info, **depth)
    Path("camera.json").write_text(json.dumps({"intrinsics": LENS} | camera))
    argv = "--import kitchen --num-points 1 --camera camera.json".split()
    convert.main([*argv, *options.split()])
    found = load_demonstrations("recordings/pour-the-tea.npz").points[:, 0]
    np.testing.assert_allclose(found[0], seen_in_one_pixel(metres), rtol=2e-3)


@pytest.mark.parametrize(
    "info, options, message",
    [
        (None, "", "nothing says in which unit observation.depth is: add --depth-unit mm, m"),
        ({"depth_unit": "inch"}, "", "'inch' does not say in which unit observation.depth is"),
        (None, "--depth-unit inch", "--depth-unit is inch: use mm, m, or metres a unit"),
        (None, "--depth-unit 0", "--depth-unit is 0: use mm, m, or metres a unit"),
    ],
)
def test_depth_in_a_unit_that_nothing_says_is_refused(info, options, message, capsys):
    dataset("kitchen", seen=DEPTH, info=info, **{DEPTH: one_pixel(700)})
    Path("camera.json").write_text(json.dumps({"intrinsics": LENS}))
    argv = "--import kitchen --camera camera.json".split()
    assert message in fails(convert, [*argv, *options.split()], capsys)


def test_single_frames_without_depth_show_what_was_seen_before_and_many_are_refused(capsys):
    depth = one_pixel(2000 + np.arange(20))
    depth[10] = 0
    dataset("kitchen", seen=DEPTH, info=MILLIMETRES, **{DEPTH: depth})
    Path("camera.json").write_text(json.dumps({"intrinsics": LENS}))
    argv = "--import kitchen --num-points 1 --camera camera.json --out".split()
    convert.main([*argv, "own"])
    assert "1 empty clouds, in whose place stands the one before" in capsys.readouterr().out
    z = load_demonstrations("own/pour-the-tea.npz").points[:, 0, 2]
    np.testing.assert_allclose(z, [2.008, 2.009, 2.009, 2.011, 2.012], atol=2e-3)

    depth[10:13] = 0
    shutil.rmtree("kitchen")
    dataset("kitchen", seen=DEPTH, info=MILLIMETRES, **{DEPTH: depth})
    message = fails(convert, [*argv, "other"], capsys)
    assert "nothing is seen in 3 of 5 frames of episode 1, first in frame 2" in message
    convert.main([*argv, "other", "--skip", "1"])
    assert "left out: episode 1 (--skip)" in capsys.readouterr().out
    assert [path.name for path in Path("other").iterdir()] == ["stir-the-soup.npz"]


def edit(**changes):
    """Changes what meta/info.json says."""
    path = Path("kitchen/meta/info.json")
    info = json.loads(path.read_text())
    path.write_text(json.dumps(info | {k: f(info.get(k)) for k, f in changes.items()}))


def without(name):
    return lambda: edit(features=lambda old: {k: f for k, f in old.items() if k != name})


def in_data(**changes):
    return lambda: rewrite("kitchen/data/chunk-000/file-000.parquet", **changes)


def write(path, content):
    return lambda: Path(path).write_bytes(content)


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 123\n"
DATA, TASKS = "kitchen/data/chunk-000/file-000.parquet", "kitchen/meta/tasks.parquet"


@pytest.mark.parametrize(
    "damage, options, message",
    [
        (without("action"), "", "it lacks action; it holds observation.state"),
        (without("observation.point_cloud"), "", "with --feature; it holds observation.state"),
        (lambda: None, "--feature observation.images.top", "observation.images.top (video)"),
        (lambda: edit(codebase_version=lambda _: "v1.6"), "", "format v1.6: convert it to v3.0"),
        (write("kitchen/meta/info.json", b"{"), "", "is no JSON object"),
        (write("kitchen/meta/info.json", b"[]"), "", "is no JSON object, but list"),
        (write("kitchen/meta/info.json", b"[" * 100_000), "", "is no JSON object"),
        (lambda: None, "--state action", "a dataset of LeRobot, for which --state has no meaning"),
        (lambda: shutil.rmtree("kitchen/data"), "", "of 3 episodes 3 are missing (0, 1, 2)"),
        (lambda: None, "--feature observation.state", "observation.state is neither"),
        (lambda: None, "--task stir", "holds 2 tasks"),
        (lambda: None, "--instruction Stir.", "leave --instruction out"),
        # Less than, or other than, what the dataset says elsewhere
        (in_data(rows=range(13)), "", "of 3 episodes 1 are missing (2): download it again"),
        (in_data(rows=range(18)), "", "episode 2 should have 7 frames, but has 5"),
        (lambda: edit(total_episodes=lambda _: 4), "", "of 4 episodes 1 are missing (3)"),
        (lambda: edit(total_frames=lambda _: 21), "", "it should have 21 frames, but has 20"),
        (in_data(rows=[*range(3), *range(4, 20)]), "", "episode 0: frame 4 where 3 belongs"),
        (in_data(rows=[1, 0, *range(2, 20)]), "", "episode 0: frame 1 where 0 belongs"),
        (in_data(rows=[*range(8, 20), *range(3, 8)]), "", "episode 0: frame 3 where 0 belongs"),
        (
            in_data(episode_index=lambda e: [*e[:4], 1, *e[5:]]),
            "",
            "episode 1: frame 4 where 0 belongs: download it again, or leave the episode out by",
        ),
        (
            in_data(timestamp=lambda t: [x + 0.3 * (i > 4) for i, x in enumerate(t)]),
            "",
            "0.400 s lie between frame 4 and the next, where 10 frames a second are 0.100 s apart",
        ),
        (lambda: edit(fps=lambda _: "10"), "", "info.json: fps is '10', no number above 0"),
        (lambda: edit(features=lambda f: f | {"x": {"dtype": "x"}}), "", "info.json: x must have"),
        (in_data(episode_index=lambda e: [None, *e[1:]]), "", "episode_index is missing in some"),
        (in_data(action=lambda a: [None, *a[1:]]), "", "action holds other than numbers of shape"),
        # Files that are not what their names say
        (write(DATA, LFS), "", "file-000.parquet: is a pointer of git-lfs"),
        (write(DATA, b"PAR1 and no more"), "", "file-000.parquet: is damaged or no parquet file"),
        (write(TASKS, LFS), "", "tasks.parquet: is a pointer of git-lfs"),
        (lambda: rewrite(TASKS, __index_level_0__=lambda _: [None, "a"]), "", "it does not say"),
        (lambda: rewrite(TASKS, __index_level_0__=lambda _: [5, 6]), "", "says by 5, which is no"),
        (lambda: os.remove(TASKS), "", "it does not say what is done: add --instruction"),
    ],
)
def test_a_wrong_dataset_is_refused_in_one_line(damage, options, message, capsys):
    dataset("kitchen")
    damage()
    assert message in fails(convert, ["--import", "kitchen", *options.split()], capsys)
    assert not Path("recordings").exists()


@pytest.mark.parametrize(
    "rows, message",
    [
        ([*range(3), *range(4, 20)], "episode 0: frame 4 where 3 belongs"),
        (range(18), "episode 2 should have 7 frames, but has 5"),
    ],
)
def test_what_is_advised_about_a_wrong_episode_leads_to_an_import(rows, message, capsys):
    dataset("kitchen")
    in_data(rows=rows)()
    line = fails(convert, ["--import", "kitchen"], capsys)
    assert message in line
    convert.main(["--import", "kitchen", *line.split(" by ")[1].split()])
    assert len(load_demonstrations("recordings/stir-the-soup.npz")) == 1 + ("incomplete" in line)


def test_what_there_is_of_an_incomplete_dataset_is_imported_where_that_is_asked_for(capsys):
    dataset("kitchen")
    in_data(rows=range(13))()
    convert.main("--import kitchen --incomplete".split())
    printed = capsys.readouterr().out
    assert "left out: what is missing (of 3 episodes 1 are missing (2)); 1 arrays" in printed
    assert load_demonstrations("recordings/stir-the-soup.npz").episode_ends.tolist() == [8]


def test_the_tasks_of_an_episode_that_does_several_become_episodes_of_their_own(capsys):
    values = dataset("kitchen")
    in_data(task_index=lambda t: [0] * 3 + [1] * 2 + [0] * 3 + t[8:])()
    convert.main("--import kitchen".split())
    assert "left out: 2 changes of task within an episode" in capsys.readouterr().out
    found = load_demonstrations("recordings/stir-the-soup.npz")
    assert found.episode_ends.tolist() == [3, 6, 13]
    np.testing.assert_array_equal(found.state[3:6], values["observation.state"][5:8])
    found = load_demonstrations("recordings/pour-the-tea.npz")
    assert found.episode_ends.tolist() == [2, 7]


def test_instructions_that_differ_in_a_dot_become_two_files(capsys):
    dataset("kitchen")
    rewrite(TASKS, __index_level_0__=lambda _: ["Open the drawer", "open the drawer."])
    convert.main("--import kitchen".split())
    for name, said in (("", "Open the drawer"), ("-2", "open the drawer.")):
        found = load_demonstrations(f"recordings/open-the-drawer{name}.npz")
        assert found.instruction == said and found.task == f"open-the-drawer{name}"
    message = fails(convert, ["--import", "kitchen"], capsys)
    assert "already exists: move it, or use another --out" in message


def test_files_are_read_as_utf_8_whatever_the_systems_own_encoding_is(monkeypatch):
    dataset("kitchen", "v2.1")
    tasks = [{"task_index": 0, "task": "Öffne die Tür."}, {"task_index": 1, "task": "Gieße Tee."}]
    lines = "\n".join(json.dumps(task, ensure_ascii=False) for task in tasks)
    Path("kitchen/meta/tasks.jsonl").write_text(lines, encoding="utf-8")
    edit(note=lambda _: "für Tee")
    information = Path("kitchen/meta/info.json")
    text = json.dumps(json.loads(information.read_text()), ensure_ascii=False)
    information.write_text(text, encoding="utf-8")
    read = Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda path, encoding="ascii": read(path, encoding))
    convert.main(["--import", "kitchen"])
    found = load_demonstrations("recordings/öffne-die-tür.npz")
    assert found.instruction == "Öffne die Tür."


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_no_tasks_are_needed_where_the_instruction_is_given(version):
    dataset("kitchen", version, task_index=np.zeros(20, int))
    for file in Path("kitchen/meta").glob("tasks.*"):
        file.unlink()
    convert.main(["--import", "kitchen", *SAY])
    assert len(load_demonstrations("recordings/stir-the-soup.npz")) == 3


def test_a_table_of_tasks_may_have_more_columns():
    dataset("kitchen")
    table = {"task_index": [0, 1], "task": ["Stir.", "Pour."], "note": ["a", "b"]}
    write_table(table, TASKS)
    convert.main(["--import", "kitchen"])
    assert load_demonstrations("recordings/stir.npz").instruction == "Stir."


def test_files_are_read_in_the_order_of_their_numbers():
    values = dataset("kitchen")
    table = pyarrow.parquet.read_table(DATA)
    for number, rows in ((999, slice(0, 8)), (1000, slice(8, 20))):
        part = table.slice(rows.start, rows.stop - rows.start)
        pyarrow.parquet.write_table(part, f"kitchen/data/chunk-000/file-{number}.parquet")
    os.remove(DATA)
    convert.main(["--import", "kitchen"])
    found = load_demonstrations("recordings/stir-the-soup.npz").state
    np.testing.assert_array_equal(found[0], values["observation.state"][0])


@pytest.mark.parametrize(
    "camera, message",
    [
        ({"camera_to_bse": POSE}, "camera_to_bse is none of intrinsics, depth_scale, camera_to_b"),
        ({"intrinsics": 600}, "intrinsics: give 4 finite numbers"),
        ({"intrinsics": ["600"] * 4}, "intrinsics: give 4 finite numbers"),
        ({"crop_low_m": [0, 0, float("nan")]}, "crop_low_m: give 3 finite numbers"),
        ({"intrinsics": LENS, "camera_to_base": MATRIX}, "camera_to_base: give 4 x 4 finite num"),
        ({"camera_to_base": [[-1, 0, 0, 0], *np.eye(4).tolist()[1:]]}, "camera_to_base: its 3 x 3"),
        ({"intrinsics": [-50.0, *LENS[1:]]}, "intrinsics: two focal lengths in pixels"),
        ({"depth_scale": -1}, "depth_scale: metres a unit of depth, such as 0.001"),
        ({"depth_scale": True}, "depth_scale: give 1 finite numbers"),
        ({"depth_scale": 10**400}, "depth_scale: give 1 finite numbers"),
        ([], "is no JSON object, but list"),
    ],
)
def test_a_wrong_camera_is_refused_in_one_line(camera, message, capsys):
    dataset("kitchen", seen=DEPTH, shape=(12, 16), info=MILLIMETRES)
    Path("camera.json").write_text(json.dumps(camera))
    argv = "--import kitchen --camera camera.json".split()
    assert f"camera.json: {message}" in fails(convert, argv, capsys)


def test_of_two_lenses_none_is_guessed_and_the_file_of_the_camera_comes_first(capsys):
    depth = np.full((20, 12, 16), 2000, np.uint16)
    lenses = {f"{side}.intrinsics": np.tile(np.float32(LENS), (20, 1)) for side in ("left", "top")}
    dataset("kitchen", seen=DEPTH, info=MILLIMETRES, **{DEPTH: depth}, **lenses)
    message = fails(convert, ["--import", "kitchen"], capsys)
    assert "has left.intrinsics, top.intrinsics: write what belongs to" in message
    Path("camera.json").write_text(json.dumps({"intrinsics": [80.0, 50.0, 8.0, 6.0]}))
    convert.main("--import kitchen --num-points 192 --camera camera.json".split())
    found = load_demonstrations("recordings/pour-the-tea.npz").points
    assert found[..., 0].max() == pytest.approx((15 - 8) / 80 * 2, abs=1e-3)


def test_intrinsics_of_another_resolution_in_the_file_of_the_camera_are_warned_of():
    dataset("kitchen", seen=DEPTH, info=MILLIMETRES, **{DEPTH: one_pixel(2000)})
    Path("camera.json").write_text(json.dumps({"intrinsics": [80.0, 100.0, 16.0, 12.0]}))
    message = "principal point, 16, 12, is far from the middle of the depth, 16 x 12: are the intr"
    with pytest.warns(UserWarning, match=message):
        convert.main("--import kitchen --camera camera.json".split())


@pytest.mark.parametrize(
    "depth, found, own",
    [
        ("obs/front_depth", ["obs/front_intrinsics", "obs/wrist_intrinsics"], 0),
        ("obs/front_depth", ["obs/wrist_intrinsics"], None),
        ("obs/front_depth", ["obs/intrinsics"], 0),
        ("obs/front_depth", ["obs/color_intrinsics"], None),
        ("obs/depth", ["obs/camera_intrinsics", "obs/wrist_intrinsics"], 0),
        ("obs/sensor_data/hand_camera/depth", ["obs/sensor_param/base_camera/intrinsic_cv"], None),
        ("obs/sensor_data/hand_camera/depth", ["obs/sensor_param/hand_camera/intrinsic_cv"], 0),
        ("observation.depth", ["left.intrinsics", "top.intrinsics"], None),
        ("observation.left_wrist.depth", ["left.intrinsics", "left_wrist.intrinsics"], 1),
    ],
)
def test_intrinsics_are_those_of_the_depths_camera_by_its_name(depth, found, own):
    if own is None:
        with pytest.raises(RecordingError, match="write what belongs to"):
            convert.of_same_camera("demo", depth, found)
    else:
        assert convert.of_same_camera("demo", depth, found) == found[own]
    assert convert.of_same_camera("demo", depth, []) is None


@pytest.mark.parametrize(
    "lens, message",
    [
        (np.transpose(MATRIX), "is not 0, 0, 1: it may be transposed"),
        ([40.0, 50.0, 16.0, 12.0], "principal point at 16, 12, far from the middle"),
    ],
)
def test_intrinsics_that_cannot_be_of_the_depth_are_refused(lens, message, capsys):
    lens = np.array(lens, np.float32)
    more = {
        DEPTH: one_pixel(2000),
        "observation.intrinsics": np.broadcast_to(lens, (20, *lens.shape)),
    }
    dataset("kitchen", seen=DEPTH, info=MILLIMETRES, **more)
    assert message in fails(convert, ["--import", "kitchen"], capsys)


def test_pose_and_crop_box_of_the_camera_hold_for_clouds_too():
    values = dataset("kitchen")
    camera = {"camera_to_base": POSE, "crop_low_m": [0, 0.5, 0], "crop_high_m": [1, 1, 2]}
    Path("camera.json").write_text(json.dumps(camera))
    convert.main("--import kitchen --camera camera.json".split())
    found = load_demonstrations("recordings/pour-the-tea.npz").points[0].astype(np.float64)
    x, y, z = values["observation.point_cloud"][8].T
    placed = np.stack([0.5 - y, x, z + 0.1], axis=-1)[(x >= 0.5) & (y <= 0.5)]
    assert len(np.unique(found, axis=0)) == len(placed) and found[:, 1].min() >= 0.5


def test_depth_without_intrinsics_says_where_to_write_them(capsys, monkeypatch):
    dataset("kitchen", seen=DEPTH, shape=(12, 16), info=MILLIMETRES)
    message = fails(convert, ["--import", "kitchen"], capsys)
    assert "observation.depth needs the camera's fx, fy, cx, cy: write them to --camera" in message
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    assert "pip install pyarrow" in fails(convert, ["--import", "kitchen"], capsys)


# ---- LeRobot's pictures and videos ---------------------------------------------------------------


def encoded(image, kind):
    """An image as a file of that kind, in memory."""
    file = io.BytesIO()
    PIL.Image.fromarray(image).save(file, kind)
    return file.getvalue()


def write_video(path, pictures, *, codec, stored_as, given_as, options):
    """A video of ten frames a second."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options=options)
        stream.width, stream.height, stream.pix_fmt = 64, 48, stored_as
        stream.time_base = Fraction(1, 10)
        for picture in pictures:
            frame = av.VideoFrame.from_ndarray(picture, format=given_as)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


QUANTIZER = {"depth_min": 0.01, "depth_max": 10.0, "shift": 3.5, "use_log": True}
DEPTH_INFO = {
    "is_depth_map": True,
    "depth_unit": "mm",
    "video.depth_min": QUANTIZER["depth_min"],
    "video.depth_max": QUANTIZER["depth_max"],
    "video.shift": QUANTIZER["shift"],
    "video.use_log": QUANTIZER["use_log"],
}


def lerobots_codes(metres):
    """How lerobot 0.6 quantizes depth with these parameters, in logarithms."""
    low, high = np.log(0.01 + 3.5), np.log(10 + 3.5)
    codes = np.rint((np.log(metres + 3.5) - low) / (high - low) * 4095)
    return codes.clip(0, 4095).astype(np.uint16)


SEEN, COLOR = "observation.images.depth", "observation.images.color"


def write_videos(name, version, pictures, **encoding):
    """Videos of the twenty frames: a file for all of them, or for each episode of the old format.

    Returns what meta/episodes says of them.
    """
    if version == "v3.0":
        write_video(Path(f"kitchen/videos/{name}/chunk-000/file-000.mp4"), pictures, **encoding)
    else:
        for episode, end in enumerate(np.cumsum(LENGTHS)):
            file = f"kitchen/videos/chunk-000/{name}/episode_{episode:06d}.mp4"
            write_video(Path(file), pictures[end - LENGTHS[episode] : end], **encoding)
    place = {f"videos/{name}/{key}": [0] * 3 for key in ("chunk_index", "file_index")}
    return place | {f"videos/{name}/from_timestamp": [0.0, 0.8, 1.3]}


def depth_video(info=DEPTH_INFO, stored_as="gray12le", version="v3.0"):
    """A dataset with a depth video, one pixel of which is not empty; returns that pixel's depth."""
    dataset("kitchen", version, depth=np.zeros((20, 48, 64)))
    depth = np.zeros((20, 48, 64))
    depth[:, 10, 20] = 0.5 + np.arange(20) / 100
    codes = lerobots_codes(depth)
    if stored_as != "gray12le":
        codes = (codes >> 4).astype(np.uint8)
    place = write_videos(
        SEEN,
        version,
        codes,
        given_as=stored_as,
        codec="libx265",
        stored_as=stored_as,
        options={"x265-params": "lossless=1:log-level=none"},
    )
    color = np.full((20, 48, 64, 3), [200, 100, 0], np.uint8)
    place_of_color = write_videos(
        COLOR,
        version,
        color,
        given_as="rgb24",
        codec="libx264",
        stored_as="yuv420p",
        options={"crf": "1"},
    )
    table = {"episode_index": [0, 1, 2], "length": LENGTHS, **place, **place_of_color}
    if version == "v3.0":
        write_table(table, "kitchen/meta/episodes/chunk-000/file-000.parquet")
    features = {
        SEEN: {"dtype": "video", "shape": [48, 64, 1], "info": info},
        COLOR: {"dtype": "video", "shape": [48, 64, 3], "info": {"is_depth_map": False}},
    }
    edit(features=lambda old: {k: f for k, f in old.items() if "cloud" not in k} | features)
    without("depth")()
    Path("camera.json").write_text(json.dumps({"intrinsics": [40.0, 50.0, 32.0, 24.0]}))
    return depth[:, 10, 20]


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_depth_and_color_of_videos_become_colored_points(version):
    metres = depth_video(version=version)
    argv = f"--import kitchen --camera camera.json --num-points 1 --color {COLOR}".split()
    convert.main(argv)
    pour = load_demonstrations("recordings/pour-the-tea.npz").points[:, 0]
    stir = load_demonstrations("recordings/stir-the-soup.npz").points[:, 0]
    np.testing.assert_allclose(pour[:, 2], metres[8:13], atol=1.5e-3)
    np.testing.assert_allclose(stir[:, 2], np.delete(metres, slice(8, 13)), atol=1.5e-3)
    np.testing.assert_allclose(stir[:, 3:], np.tile([200 / 255, 100 / 255, 0], (15, 1)), atol=0.02)


def test_a_depth_video_of_a_camera_with_another_unit_is_as_many_times_as_far():
    metres = depth_video()  # lerobot took what the camera gave for millimetres
    argv = "--import kitchen --camera camera.json --num-points 1 --depth-unit 0.0001"
    convert.main(argv.split())
    z = load_demonstrations("recordings/pour-the-tea.npz").points[:, 0, 2]
    np.testing.assert_allclose(z, metres[8:13] / 10, atol=2e-4)


@pytest.mark.parametrize("use_log", [True, False])
def test_codes_of_depth_become_metres_and_the_ends_of_the_range_nothing(use_log):
    parameters = dict(QUANTIZER, use_log=use_log)
    codes = np.array([0, 1, 2000, 4094, 4095], np.uint16)
    metres = convert.dequantize(codes, **parameters)
    assert metres[0] == metres[4] == 0
    if use_log:
        np.testing.assert_array_equal(lerobots_codes(metres[1:4]), codes[1:4])
    else:
        np.testing.assert_allclose(metres[1:4], 0.01 + codes[1:4] / 4095 * 9.99, rtol=1e-6)


@pytest.mark.parametrize(
    "damage, message",
    [
        (lambda: shutil.rmtree("kitchen/videos"), "file-000.mp4: is missing: download it again"),
        (
            write(VIDEO := "kitchen/videos/observation.images.depth/chunk-000/file-000.mp4", LFS),
            "lfs",
        ),
        (write(VIDEO, b"no video"), "file-000.mp4: is damaged or no video"),
        (
            lambda: rewrite(
                "kitchen/meta/episodes/chunk-000/file-000.parquet",
                **{"videos/observation.images.depth/from_timestamp": lambda _: [0.0, 0.8, 1.5]},
            ),
            "file-000.mp4: lacks the picture at 2.000 s, episode 2",
        ),
        (lambda: shutil.rmtree("kitchen/meta/episodes"), "meta/episodes lacks videos/observation"),
        (lambda: sys.modules.__setitem__("av", None), "pip install av"),
    ],
)
def test_a_wrong_video_is_refused_in_one_line(damage, message, capsys, monkeypatch):
    depth_video()
    monkeypatch.setitem(sys.modules, "av", sys.modules["av"])
    damage()
    argv = "--import kitchen --camera camera.json".split()
    assert message in fails(convert, argv, capsys)


@pytest.mark.parametrize(
    "info, stored_as, message",
    [
        (DEPTH_INFO, "gray", "is gray, not depth in 12 bits"),
        ({"is_depth_map": True}, "gray12le", "does not say video.depth_min, video.depth_max, vid"),
    ],
)
def test_a_video_that_cannot_be_depth_is_refused(info, stored_as, message, capsys):
    depth_video(info, stored_as)
    argv = "--import kitchen --camera camera.json".split()
    assert message in fails(convert, argv, capsys)


def test_depth_and_color_of_pictures_become_colored_points(capsys):
    depth, color = one_pixel(700), np.zeros((20, 12, 16, 3), np.uint8)
    color[:, 3, 10] = [255, 51, 0]
    pictures = {
        DEPTH: [encoded(image, "TIFF") for image in depth],
        "observation.images.front": [encoded(image, "PNG") for image in color],
    }
    dataset("kitchen", seen=DEPTH, info={"is_depth_map": True, "depth_unit": "mm"}, **pictures)
    Path("camera.json").write_text(json.dumps({"intrinsics": LENS}))
    argv = "--import kitchen --num-points 12 --camera camera.json --color".split()
    message = fails(convert, argv, capsys)
    assert "name the color of observation.depth, --color NAME; its pictures: observ" in message
    convert.main([*argv, "observation.images.front"])
    found = load_demonstrations("recordings/pour-the-tea.npz").points
    expected = [*seen_in_one_pixel(0.7), 1, 0.2, 0]
    np.testing.assert_allclose(found[2, 5], expected, rtol=2e-3)


def test_a_picture_with_a_damaged_chunk_is_refused_in_one_line(capsys):
    depth = RNG.integers(1, 60_000, (20, 300, 300), np.uint16)  # so large that it has many chunks
    pictures = [encoded(image, "PNG") for image in depth]
    chunks = [place for place in range(len(pictures[0])) if pictures[0].startswith(b"IDAT", place)]
    assert len(chunks) > 1
    damaged = bytearray(pictures[0])
    damaged[chunks[1]] ^= 0xFF
    info = {"is_depth_map": True, "depth_unit": "mm"}
    dataset("kitchen", seen=DEPTH, info=info, **{DEPTH: [bytes(damaged), *pictures[1:]]})
    Path("camera.json").write_text(json.dumps({"intrinsics": LENS}))
    message = fails(convert, "--import kitchen --camera camera.json".split(), capsys)
    assert "file-000.parquet: is damaged or holds no images: broken PNG file" in message


# ---- HDF5 ----------------------------------------------------------------------------------------


def robomimic(path, seen="pointcloud", **changes):
    """Two demonstrations of 8 and 12 frames, as robomimic writes them."""
    values = {}
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = 20
        for name, T in (("demo_10", 12), ("demo_9", 8)):
            arrays = {
                "actions": RNG.normal(size=(T, 7)),
                "rewards": np.zeros(T),
                "obs/robot0_eef_pos": RNG.normal(size=(T, 3)),
                "obs/robot0_eef_quat": RNG.normal(size=(T, 4)),
                "obs/robot0_gripper_qpos": RNG.normal(size=(T, 2)),
                f"obs/{seen}": RNG.uniform(0.1, 1, (T, 30, 3)),
            }
            for key, change in changes.items():
                arrays[key] = change(T)
            group = data.create_group(name)
            group.attrs["num_samples"] = T
            for key, value in arrays.items():
                group[key] = value
            values[name] = arrays
    return values


def test_demonstrations_of_robomimic_become_a_recording(capsys):
    values = robomimic("demo.hdf5")
    convert.main(["--import", "demo.hdf5", *SAY, "--num-points", "30"])
    assert "left out: 1 arrays (rewards)" in capsys.readouterr().out
    found = load_demonstrations("recordings/stir-the-soup.npz")
    assert found.episode_ends.tolist() == [8, 20]  # demo_9 comes before demo_10
    parts = ["robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"]
    state = np.concatenate([values["demo_9"][f"obs/{part}"] for part in parts], axis=1)
    np.testing.assert_allclose(found.state[:8], state, rtol=1e-6)
    np.testing.assert_allclose(found.action[8:], values["demo_10"]["actions"], rtol=1e-6)
    cloud = {tuple(p) for p in np.float16(np.float32(values["demo_9"]["obs/pointcloud"][3]))}
    assert {tuple(p) for p in found.points[3]} == cloud


def test_depth_and_color_of_robomimic_become_colored_points():
    depth, color = np.zeros((12, 12, 16, 1), np.float32), np.zeros((12, 12, 16, 3), np.uint8)
    depth[:, 3, 10], color[:, 3, 10] = 0.7, [0, 51, 255]
    more = {"obs/front_depth": lambda T: depth[:T], "obs/front_image": lambda T: color[:T]}
    robomimic("demo.hdf5", **more)
    Path("camera.json").write_text(json.dumps({"intrinsics": LENS}))
    argv = "--feature obs/front_depth --depth-unit m --camera camera.json --color".split()
    convert.main(["--import", "demo.hdf5", *SAY, *argv])
    found = load_demonstrations("recordings/stir-the-soup.npz").points
    np.testing.assert_allclose(found[9, 0], [*seen_in_one_pixel(0.7), 0, 0.2, 1], rtol=2e-3)


def test_colors_in_the_points_of_hdf5_are_kept(capsys):
    cloud = RNG.uniform(0.1, 1, (12, 30, 6))
    robomimic("demo.hdf5", **{"obs/pointcloud": lambda T: cloud[:T]})
    convert.main(["--import", "demo.hdf5", *SAY, "--num-points", "30", "--color"])
    found = load_demonstrations("recordings/stir-the-soup.npz").points
    expected = {tuple(p) for p in np.float16(np.float32(cloud[3]))}
    assert {tuple(p) for p in found[3]} == expected


@pytest.mark.parametrize(
    "unit, message", [("mm", None), (0.0001, None), (b"m", None), ("inch", "'inch' does not say")]
)
def test_the_unit_of_depth_may_be_an_attribute_of_it(unit, message, capsys):
    metres = {"mm": 0.7, 0.0001: 0.07, b"m": 7}.get(unit)
    stored = 7 if unit == b"m" else 700
    robomimic("demo.hdf5", **{"obs/depth": lambda T: one_pixel(stored)[:T]})
    with h5py.File("demo.hdf5", "a") as file:
        del file["data/demo_9/obs/pointcloud"]
        file["data/demo_9/obs/depth"].attrs["unit"] = unit
    Path("camera.json").write_text(json.dumps({"intrinsics": LENS}))
    argv = ["--import", "demo.hdf5", *SAY, "--camera", "camera.json"]
    if message:
        assert message in fails(convert, argv, capsys)
        return
    convert.main(argv)
    found = load_demonstrations("recordings/stir-the-soup.npz").points
    np.testing.assert_allclose(found[0, 0], seen_in_one_pixel(metres), rtol=3e-3)


def test_the_instruction_of_libero_is_read():
    robomimic("demo.hdf5")
    with h5py.File("demo.hdf5", "a") as file:
        problem = {"language_instruction": "open the drawer"}
        file["data"].attrs["problem_info"] = json.dumps(problem)
    convert.main(["--import", "demo.hdf5"])
    found = load_demonstrations("recordings/open-the-drawer.npz")
    assert found.instruction == "open the drawer"


def maniskill(path, seen):
    """A trajectory as ManiSkill writes it: one observation more than actions."""
    T = 8
    with h5py.File(path, "w") as file:
        group = file.create_group("traj_0")
        group["actions"] = RNG.normal(size=(T, 7)).astype(np.float32)
        group["obs/agent/qpos"] = RNG.normal(size=(T + 1, 9)).astype(np.float32)
        group["obs/extra/tcp_pose"] = RNG.normal(size=(T + 1, 7)).astype(np.float32)
        for name, value in seen.items():
            group[f"obs/{name}"] = np.repeat(np.asarray(value)[None], T + 1, axis=0)
    lengths = {"episodes": [{"episode_id": 0, "elapsed_steps": T}]}
    Path(path).with_suffix(".json").write_text(json.dumps(lengths))


@pytest.mark.parametrize("said", [{"episodes": None}, {"episodes": 3}, {"episodes": [1]}, {}])
def test_what_the_json_beside_a_file_does_not_say_is_not_compared(said):
    depth = one_pixel(700, np.int16)[0][..., None]
    parameters = {"intrinsic_cv": np.float32(MATRIX)}
    seen = {f"sensor_param/front/{name}": value for name, value in parameters.items()}
    maniskill("demo.h5", {"sensor_data/front/depth": depth} | seen)
    Path("demo.json").write_text(json.dumps(said))
    convert.main(["--import", "demo.h5", *SAY, "--depth-unit", "mm"])
    assert len(load_demonstrations("recordings/stir-the-soup.npz")) == 1


def test_depth_of_maniskill_is_seen_by_its_own_camera():
    to_camera = np.linalg.inv(POSE)[:3]
    depth = one_pixel(700, np.int16)[0][..., None]
    parameters = {"intrinsic_cv": np.float32(MATRIX), "extrinsic_cv": np.float32(to_camera)}
    seen = {f"sensor_param/front/{name}": value for name, value in parameters.items()}
    maniskill("demo.h5", {"sensor_data/front/depth": depth} | seen)
    convert.main(["--import", "demo.h5", *SAY, "--depth-unit", "mm"])
    found = load_demonstrations("recordings/stir-the-soup.npz")
    assert found.episode_ends.tolist() == [8] and found.state.shape == (8, 16)
    x, y, z = seen_in_one_pixel(0.7)
    np.testing.assert_allclose(found.points[0, 0], [0.5 - y, x, z + 0.1], rtol=2e-3)


@pytest.mark.parametrize(
    "extrinsics",
    [np.zeros((3, 4)), np.ones(16), np.full((4, 4), np.nan), np.transpose(np.linalg.inv(POSE))],
)
def test_extrinsics_that_are_no_pose_are_refused(extrinsics, capsys):
    seen = {
        "sensor_data/front/depth": one_pixel(700, np.int16)[0][..., None],
        "sensor_param/front/intrinsic_cv": np.float32(MATRIX),
        "sensor_param/front/extrinsic_cv": np.float32(extrinsics),
    }
    maniskill("demo.h5", seen)
    message = fails(convert, ["--import", "demo.h5", *SAY, "--depth-unit", "mm"], capsys)
    assert "extrinsic_cv" in message


def test_damaged_hdf5_files_are_read_or_refused(capsys):
    """Where something is wrong with its structure, h5py raises errors of several kinds."""
    maniskill("demo.h5", {"pointcloud/xyzw": RNG.normal(size=(30, 4)).astype(np.float32)})
    whole = Path("demo.h5").read_bytes()
    refused = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        damaged = bytearray(whole)
        for place in rng.integers(len(whole), size=20):
            damaged[place] = rng.integers(256)
        Path("demo.h5").write_bytes(damaged)
        try:
            convert.main(
                ["--import", "demo.h5", *SAY, "--num-points", "20", "--out", f"own-{seed}"]
            )
        except RecordingError:
            refused += 1
    assert refused > 5


def test_points_that_maniskill_did_not_see_are_left_out(capsys):
    cloud = np.append(RNG.uniform(0.1, 1, (30, 3)), np.ones((30, 1)), axis=1).astype(np.float32)
    cloud[:10, 3] = 0
    color = np.full((30, 3), 255, np.uint8)
    maniskill("demo.h5", {"pointcloud/xyzw": cloud, "pointcloud/rgb": color})
    convert.main(["--import", "demo.h5", *SAY, "--num-points", "20", "--color"])
    assert (
        "left out: 80 points at NaN or at the origin; 1 observation after"
        in capsys.readouterr().out
    )
    found = load_demonstrations("recordings/stir-the-soup.npz").points
    assert {tuple(p) for p in found[3, :, :3]} == {tuple(p) for p in np.float16(cloud[10:, :3])}
    assert (found[..., 3:] == 1).all()


@pytest.mark.parametrize("actions", [0, 5])
@pytest.mark.parametrize("number, T", [(9, 8), (10, 12)])
def test_a_damaged_demonstration_is_left_out_as_the_error_advises(number, T, actions, capsys):
    values = robomimic("demo.hdf5")
    with h5py.File("demo.hdf5", "a") as file:
        del file[f"data/demo_{number}/actions"]
        file[f"data/demo_{number}/actions"] = np.zeros((actions, 7))
    message = fails(convert, ["--import", "demo.hdf5", *SAY], capsys)
    assert f"episode {number} has {actions or 'no'} actions" in message
    convert.main(["--import", "demo.hdf5", *SAY, *message.split(" by ")[1].split()])
    assert f"episode {number} (--skip)" in capsys.readouterr().out
    found = load_demonstrations("recordings/stir-the-soup.npz")
    other = values[f"demo_{19 - number}"]["actions"]
    np.testing.assert_allclose(found.action, other, rtol=1e-6)


def test_an_array_of_which_a_demonstration_has_none_is_named_unless_that_is_left_out(capsys):
    robomimic("demo.hdf5")
    change_hdf5(lambda file: file.pop("data/demo_9/obs/robot0_eef_pos"))()
    message = fails(convert, ["--import", "demo.hdf5", *SAY], capsys)
    assert "name the arrays of the state with --state" in message  # the first one decides
    convert.main(["--import", "demo.hdf5", *SAY, "--skip", "9"])
    assert load_demonstrations("recordings/stir-the-soup.npz").episode_ends.tolist() == [12]


def change_hdf5(change):
    def damage():
        with h5py.File("demo.hdf5", "a") as file:
            change(file)

    return damage


@pytest.mark.parametrize(
    "damage, options, message",
    [
        (lambda: None, [], "it does not say what is done: add --instruction"),
        (change_hdf5(lambda f: f.pop("data/demo_9")), SAY, "should have 20 frames, but has 12"),
        (change_hdf5(lambda f: f.pop("data/demo_9/actions")), SAY, "it lacks actions"),
        (change_hdf5(lambda f: f.pop("data/demo_10/actions")), SAY, "episode 10 has no actions"),
        (lambda: None, [*SAY, "--skip", "9", "10"], "--skip leaves no episode"),
        (
            change_hdf5(lambda f: f["data/demo_9"].attrs.modify("num_samples", 9)),
            SAY,
            "episode 9 should have 9 frames, but has 8",
        ),
        (change_hdf5(lambda f: f.move("data", "other")), SAY, "holds no data/demo_0 or traj_0; it"),
        (lambda: None, [*SAY, "--state", "obs/pose"], "name the arrays of the state with --state"),
        (lambda: None, [*SAY, "--feature", "obs/depth"], "obs/depth is neither a cloud (N, 3)"),
        (lambda: os.truncate("demo.hdf5", 3000), SAY, "demo.hdf5: is damaged or no HDF5 file"),
        (lambda: sys.modules.__setitem__("h5py", None), SAY, "pip install h5py"),
    ],
)
def test_wrong_hdf5_is_refused_in_one_line(damage, options, message, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", h5py)
    robomimic("demo.hdf5")
    damage()
    assert message in fails(convert, ["--import", "demo.hdf5", *options], capsys)
    assert not Path("recordings").exists()


# ---- RLBench; more of it is in test_rlbench.py ---------------------------------------------------


@pytest.mark.parametrize("number", [0, 1])
def test_a_damaged_episode_of_rlbench_can_be_left_out(number, capsys, monkeypatch):
    standin.install(monkeypatch)
    variation = standin.write_task("rlbench/close_box", episodes=2)  # 4 and 5 frames
    os.truncate(variation / "episodes" / f"episode{number}" / "low_dim_obs.pkl", 3000)
    assert "is damaged or no pickle" in fails(convert, ["--import", "rlbench"], capsys)
    convert.main(["--import", "rlbench", "--skip", str(number)])
    assert f"episode {number} (--skip)" in capsys.readouterr().out
    found = load_demonstrations("recordings/close_box.npz")
    assert found.episode_ends.tolist() == [4 - number]
