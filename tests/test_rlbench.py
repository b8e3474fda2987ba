"""Tests of rlbench_data.py, of the import of RLBench's data sets, and of rlbench_env.py.

RLBench is not installed here. rlbench_standin.py has its interface and writes files as it does.
"""

import os
import pickle
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
import rlbench_standin as standin
import torch
from conftest import fails
from scipy.spatial.transform import Rotation

import convert
import evaluate
import rlbench_data
import rlbench_env
import simulator
from data import RecordingError, load_demonstrations
from geometry import SAMPLED_FROM
from model import PRESETS

pytestmark = pytest.mark.usefixtures("own_folder")
RNG = np.random.default_rng(0)
TASKS = ("CloseBox", "OpenBox")


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    """The stand-in in the place of RLBench, and a process that has not begun an episode."""
    standin.install(monkeypatch, TASKS)
    monkeypatch.setattr(rlbench_env, "running", {})


def imported(path, *options):
    convert.main(["--import", str(path), "--out", "data", *options])
    return {file.stem: load_demonstrations(file) for file in sorted(Path("data").glob("*.npz"))}


# ---- States and actions --------------------------------------------------------------------------


def random_pose():
    return np.array([*RNG.uniform(-1, 1, 3), *Rotation.random(rng=RNG).as_quat()])


def test_an_action_leads_from_a_pose_to_the_next_one_and_back_to_what_rlbench_takes():
    poses = [random_pose() for _ in range(200)]
    poses += [np.array([0, 0, 0, *q]) for q in (np.eye(4)[3], -np.eye(4)[3], np.eye(4)[1])]
    for pose, following in zip(poses, poses[1:] + poses[:1]):
        opened = float(RNG.integers(2))
        state = rlbench_data.state_of(pose, 1.0 - opened)
        action = rlbench_data.action_between(state, rlbench_data.state_of(following, opened))

        now, then = Rotation.from_quat(pose[3:]), Rotation.from_quat(following[3:])
        assert ((then * now.inv()) * Rotation.from_rotvec(action[3:6]).inv()).magnitude() < 1e-9
        np.testing.assert_allclose(action[:3], following[:3] - pose[:3], atol=1e-12)
        assert action[6] == opened

        target = rlbench_data.target_of(state, action)
        np.testing.assert_allclose(target[:3], following[:3], atol=1e-12)
        assert (Rotation.from_quat(target[3:7]) * then.inv()).magnitude() < 1e-7
        assert np.linalg.norm(target[3:7]) == pytest.approx(1, abs=1e-12) and target[7] == opened


def test_a_state_has_the_rotation_vector_that_is_nearer_to_a_gripper_that_points_down():
    for pose in [random_pose() for _ in range(100)]:
        state = rlbench_data.state_of(pose, 1.0)
        rotation = Rotation.from_rotvec(state[3:6])
        assert (rotation * Rotation.from_quat(pose[3:]).inv()).magnitude() < 1e-9
        near = np.array([0, np.pi, 0])
        angle = np.linalg.norm(state[3:6])
        other = state[3:6] * (1 - 2 * np.pi / angle)
        distance = np.linalg.norm(state[3:6] - near)
        assert distance <= np.linalg.norm(other - near) + 1e-9
        mirrored = rlbench_data.state_of(np.array([*pose[:3], *-pose[3:]]), 1.0)
        np.testing.assert_allclose(mirrored, state, atol=1e-9)  # q and -q are one rotation


# ---- Clouds --------------------------------------------------------------------------------------


def distance_to_scene(points, box=standin.BOX):
    """How far points (M, 3) are from the table top or the sides of the box, (M,) metres."""
    table = np.abs(points[:, 2] - standin.TABLE)
    outside = np.linalg.norm(points - points.clip(*box), axis=1)
    inside = np.minimum(points - box[0], box[1] - points).min(axis=1)
    return np.minimum(table, np.where(inside > 0, inside, outside))


def view_of(camera):
    depth = standin.decoded(standin.depth_of(camera))
    return rlbench_data.read_view("here", standin.camera_misc(camera), camera, depth)


@pytest.mark.parametrize("camera", standin.CAMERAS)
def test_each_pixel_becomes_the_point_that_its_ray_meets(camera):
    metres = standin.depth_of(camera)[..., None]
    met = standin.CAMERAS[camera] + metres * standin.rays(camera)  # (H, W, 3)
    points = view_of(camera).points()
    np.testing.assert_allclose(points, met.reshape(-1, 3), atol=1e-5)
    assert (distance_to_scene(points) < 1e-5).mean() > 0.7  # the others are at the far plane


def test_a_cloud_is_of_all_cameras_inside_of_the_workspace():
    views = [view_of(camera) for camera in rlbench_data.CAMERAS]
    points = rlbench_data.seen_points(views)
    low, high = rlbench_data.WORKSPACE
    assert (points >= low).all() and (points <= high).all()
    assert 1000 < len(points) <= SAMPLED_FROM and points.dtype == np.float32
    of_one = [set(map(tuple, view.points())) for view in views]
    assert all(len(seen & set(map(tuple, points))) > 300 for seen in of_one)
    narrow = rlbench_data.seen_points(views, [[0.2, 0, 0.8], [0.3, 0.1, 1.0]])
    assert 0 < len(narrow) < len(points) and (narrow[:, 0] >= 0.2).all()


# ---- The import ----------------------------------------------------------------------------------


def test_an_episode_becomes_a_recording_whose_points_are_right_to_a_millimetre(capsys):
    standin.write_task("rlbench/close_box", episodes=2)
    recording = imported("rlbench")["close_box"]
    assert (recording.task, recording.instruction) == ("close_box", "touch the box")
    assert recording.episode_ends.tolist() == [3, 7]  # 4 and 5 frames, the last of each left out
    assert recording.points.shape == (7, 512, 3)
    for cloud in recording.points.astype(np.float64):
        assert distance_to_scene(cloud).max() < 1e-3
        on_box = cloud[:, 2] > standin.TABLE + 0.01
        assert on_box.sum() > 30 and (~on_box).sum() > 100
        for side in (0, 1, 2, 4, 5):  # all sides but the one that faces no camera, and the bottom
            axis, corner = side % 3, side // 3
            if (axis, corner) not in ((0, 0), (2, 0)):
                at = np.abs(cloud[on_box][:, axis] - standin.BOX[corner, axis]) < 1e-3
                assert at.sum() > 3, (axis, corner)

    poses = standin.path_of_gripper(4, (0.3, 0.05, 0.88))
    np.testing.assert_allclose(recording.state[:3, :3], poses[:3, :3], atol=1e-6)
    np.testing.assert_allclose(recording.action[:3, :3], np.diff(poses[:, :3], axis=0), atol=1e-6)
    turns = [Rotation.from_rotvec(state[3:6]) for state in recording.state[:3]]
    for turn, pose in zip(turns, poses):
        assert (turn * Rotation.from_quat(pose[3:]).inv()).magnitude() < 1e-5
    assert recording.state[:3, 6].tolist() == [1, 1, 1]
    assert recording.action[:3, 6].tolist() == [1, 1, 0]
    printed = capsys.readouterr().out
    assert "the last frame of each episode" in printed and "front_mask" in printed
    assert len(printed.splitlines()) == 1  # nothing looks wrong in it


def test_what_the_import_says_of_a_recording_is_what_augmentation_and_suite_need():
    standin.write_task("rlbench/close_box")
    meta = imported("rlbench", "--num-points", "64")["close_box"].meta
    assert meta["positions_in_state"] == 1 and meta["rotation_near_rad"] == [0, 3.14159, 0]
    assert meta["workspace"] == [[-0.3, -0.5, 0.6], [0.7, 0.5, 1.6]] and meta["num_points"] == 64
    assert meta["cameras"] == ["front", "left_shoulder", "right_shoulder"]
    assert {**rlbench_data.RECIPE, "num_points": 64}.items() <= meta.items()
    assert not simulator.made_by_simulator(load_demonstrations("data/close_box.npz"))


@pytest.mark.parametrize("folder", ["rlbench", "rlbench/close_box", "rlbench/close_box/variation0"])
def test_a_data_set_a_task_or_a_variation_can_be_named(folder):
    standin.write_task("rlbench/close_box")
    episodes = Path("rlbench/close_box/variation0/episodes")
    number = len(list(episodes.iterdir()))
    shutil.copytree(episodes / "episode0", episodes / "episode0_backup")  # is no episode
    recordings = imported(folder)
    assert list(recordings) == ["close_box"] and len(recordings["close_box"]) == number


def test_each_task_and_variation_has_a_recording_of_its_own():
    standin.write_task("rlbench/open_box", descriptions=["open it"])
    standin.write_task("rlbench/close_box", episodes=2)
    source = standin.write_task("elsewhere/close_box", descriptions=["close the red box"])
    source.rename("rlbench/close_box/variation10")
    found = imported("rlbench")
    lengths = {name: len(recording) for name, recording in found.items()}
    assert lengths == {"close_box": 2, "close_box-variation10": 1, "open_box": 1}
    assert found["close_box-variation10"].instruction == "close the red box"


def test_episodes_of_all_variations_say_their_own():
    """By a number beside them, or in each frame; and by descriptions of their own."""
    folder = Path("rlbench/close_box/all_variations/episodes")
    for number, (variation, said) in enumerate([(2, "the red box"), (0, "the box"), (2, None)]):
        observations, depths = standin.make_observations(4)
        if said is None:
            for observation in observations:
                observation.misc["variation_index"] = variation
        standin.write_episode(folder / f"episode{number}", observations, depths)
        described = [said or "the red box", "another"]
        episode = folder / f"episode{number}"
        (episode / "variation_descriptions.pkl").write_bytes(pickle.dumps(described))
        if said is not None:
            (episode / "variation_number.pkl").write_bytes(pickle.dumps(variation))
    found = imported("rlbench")
    lengths = {name: len(recording) for name, recording in found.items()}
    assert lengths == {"close_box": 1, "close_box-variation2": 2}
    assert found["close_box-variation2"].instruction == "the red box"


def test_the_wrist_is_seen_where_it_is_asked_for_and_a_crop_box_is_the_one_of_camera():
    standin.write_task("rlbench/close_box")
    crop = '{"crop_low_m": [0.1, -0.1, 0.8], "crop_high_m": [0.4, 0.2, 1.0]}'
    Path("camera.json").write_text(crop)
    recording = imported("rlbench", "--wrist", "--camera", "camera.json")["close_box"]
    assert recording.meta["cameras"] == ["front", "left_shoulder", "right_shoulder", "wrist"]
    assert recording.meta["workspace"] == [[0.1, -0.1, 0.8], [0.4, 0.2, 1.0]]
    assert recording.points[..., 2].min() >= 0.8 - 1e-3
    only_wrist = view_of("wrist").points()
    seen = {tuple(p) for p in np.float16(only_wrist)}
    assert seen & {tuple(p) for p in recording.points[0]}


@pytest.mark.parametrize(
    "described, instruction",
    [
        (["close it", "shut it"], "close it"),
        (("close it",), "close it"),
        ("close it", "close it"),
        ([], None),
        ([3], None),
        ({"vanilla": ["close it"]}, None),
        (np.arange(3), None),
    ],
)
def test_descriptions_may_hold_something_else(described, instruction, capsys):
    variation = standin.write_task("rlbench/close_box")
    (variation / "variation_descriptions.pkl").write_bytes(pickle.dumps(described))
    if instruction is None:
        message = fails(convert, ["--import", "rlbench"], capsys)
        assert "does not say what is done: add --instruction" in message
        instruction = "Close the box."
        (variation / "variation_descriptions.pkl").unlink()  # nor is it needed then
        assert imported("rlbench", "--instruction", instruction)
    assert imported_instruction(instruction) == instruction


def imported_instruction(instruction):
    if not Path("data").exists():
        imported("rlbench")
    return load_demonstrations("data/close_box.npz").instruction


def test_older_files_without_actions_and_newer_ones_are_read_alike():
    """Their frames may also lack values, as those of an older RLBench do, and have more of them."""
    observations, depths = standin.make_observations(4)
    for observation in observations:
        observation.misc["joint_position_action"] = np.zeros(8)
        observation.misc.pop("joint_poses")
        observation.task_low_dim_state = np.array([None, "x"], object)  # is never looked at
    standin.write_episode("new/close_box/variation0/episodes/episode0", observations, depths)
    standin.write_task("old/close_box")
    description = Path("old/close_box/variation0/variation_descriptions.pkl").read_bytes()
    Path("new/close_box/variation0/variation_descriptions.pkl").write_bytes(description)
    convert.main(["--import", "new", "--out", "a"])
    convert.main(["--import", "old", "--out", "b"])
    new, old = (load_demonstrations(f"{folder}/close_box.npz") for folder in "ab")
    assert np.array_equal(new.points, old.points) and np.array_equal(new.action, old.action)


# ---- Pickles -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "protocol, numpy_name", [(3, b"numpy.core"), (3, b"numpy._core"), (4, None), (5, None)]
)
def test_numbers_of_a_pickle_are_numpys_own(protocol, numpy_name):
    """Also under the names of NumPy 1. Protocol 3 has names without their length."""
    values = {
        "matrix": RNG.normal(size=(3, 4)),
        "turned": RNG.normal(size=(3, 4)).T,
        "swapped": RNG.normal(size=(2, 3, 4)).transpose(1, 0, 2),
        "pixels": np.arange(5, dtype=np.uint8),
        "big": np.arange(3, dtype=">i4"),
        "flags": np.array([True, False]),
        "single": np.float32(1.5),
        "whole": np.int64(-7),
        "plain": 2.5,
        "listed": [1, 2.5],
        "empty": np.zeros((0, 3)),
    }
    data = pickle.dumps(values, protocol)
    if numpy_name is not None:
        assert b"numpy._core" in data
        data = data.replace(b"numpy._core", numpy_name)
    Path("x.pkl").write_bytes(data)
    found = rlbench_data.read_pickle(Path("x.pkl"))
    for name, value in values.items():
        numbers = rlbench_data.read_numbers("x.pkl", name, found[name])
        np.testing.assert_array_equal(numbers, np.asarray(value, np.float64), err_msg=name)


class Runs:
    """Pickled, it makes a file when it is read by pickle itself."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def named(module, name):
    """A pickle of protocol 4 that calls a name with "touch executed"."""
    parts = [module, name, "touch executed"]
    strings = [b"\x8c" + bytes([len(part)]) + part.encode() for part in parts]
    return b"\x80\x04" + strings[0] + strings[1] + b"\x93" + strings[2] + b"\x85R."


MALICIOUS = {
    "a function": pickle.dumps(Runs(os.system, "touch executed")),
    "a function, protocol 0": pickle.dumps(Runs(os.system, "touch executed"), 0),
    "eval": pickle.dumps(Runs(eval, "open('executed', 'w')")),
    "getattr": pickle.dumps(Runs(getattr, "x", "upper")),
    "inside of a list": pickle.dumps([1, {"a": Runs(os.system, "touch executed")}]),
    "inside of an object array": pickle.dumps(
        np.array([Runs(os.system, "touch executed"), 1], object)
    ),
    "an attribute of an allowed name": named("numpy", "dtype.__class__"),
    "a way through an allowed module": named("numpy", "f2py.os.system"),
    "a dotted module": named("numpy._core.multiarray.os", "system"),
    "another name of an allowed module": named("numpy", "load"),
    "what numpy's own unpickler knows": named("numpy._core.numeric", "sys.modules"),
    "an instance, by an old opcode": b"(S'touch executed'\nios\nsystem\n.",
    "an object, by an old opcode": b"(cos\nsystem\nS'touch executed'\no.",
    "a persistent id": b"Ptouch executed\n.",
    "a registered extension": b"\x80\x02\x82\x01.",
    "attributes of an allowed class": b"crlbench.demo\nDemo\n}S'state'\nI1\nsb.",
    "attributes of an allowed class, by slots": b"crlbench.demo\nDemo\n(N}S'x'\nI1\nstb.",
    "keyword arguments": b"\x80\x04\x8c\x0crlbench.demo\x8c\x04Demo\x93)}\x8c\x01xK\x01s\x92.",
    "a line end in a name": named("os\nx", "system"),
}


@pytest.mark.parametrize("data", MALICIOUS.values(), ids=MALICIOUS)
def test_a_malicious_pickle_is_refused_in_one_line_and_executes_nothing(data, capsys):
    before = {kind: dict(vars(kind)) for kind in rlbench_data.Kept.__subclasses__()}
    variation = standin.write_task("rlbench/close_box")
    (variation / "episodes" / "episode0" / "low_dim_obs.pkl").write_bytes(data)
    message = fails(convert, ["--import", "rlbench"], capsys)
    assert "low_dim_obs.pkl: " in message and len(message) < 400
    (variation / "episodes" / "episode0" / "low_dim_obs.pkl").unlink()
    standin.write_task("other/close_box")
    described = Path("other/close_box/variation0/variation_descriptions.pkl")
    described.write_bytes(data)
    assert "variation_descriptions.pkl: " in fails(convert, ["--import", "other"], capsys)
    assert not Path("executed").exists() and not Path("recordings").exists()
    assert {kind: dict(vars(kind)) for kind in rlbench_data.Kept.__subclasses__()} == before


def test_the_malicious_pickles_are_malicious(monkeypatch):
    """Read by pickle itself they do what they must not do here."""
    for name in ("a function", "an instance, by an old opcode", "inside of an object array"):
        pickle.loads(MALICIOUS[name])
        Path("executed").unlink()


def kept(kind, *arguments, state=None):
    """What is kept of a call in a pickle, and of the state that follows it."""
    value = kind(*arguments)
    value.__setstate__(state)
    return value


FLOAT = kept(rlbench_data.DType, "f8", False, True, state=(3, "<", None, None, None, -1, -1, 0))
OBJECT = kept(rlbench_data.DType, "O8", False, True, state=(3, "|", None, None, None, -1, -1, 63))


@pytest.mark.parametrize(
    "value",
    [
        kept(rlbench_data.Array, rlbench_data.Demo, (10**12,), b"b"),
        kept(rlbench_data.Array, state=(1, (10**12,), FLOAT, False, bytes(56))),
        kept(rlbench_data.Array, state=(1, (7,), OBJECT, False, [None] * 7)),
        kept(rlbench_data.Array, state=(1, (7,), OBJECT, False, bytes(56))),
        kept(rlbench_data.Array, state=(1, (7,), rlbench_data.DType(), False, bytes(56))),
        kept(rlbench_data.Array, state=(1, (7,), "f8", False, bytes(56))),
        kept(rlbench_data.Array, state=(1, (-1, 7), FLOAT, False, bytes(57))),
        kept(rlbench_data.Array, state=(1, "seven", FLOAT, False, bytes(56))),
        kept(rlbench_data.BufferArray, [0.0] * 7, FLOAT, (7,), "C"),
        kept(rlbench_data.BufferArray, bytes(56), FLOAT),
        kept(rlbench_data.BufferArray, bytes(56), FLOAT, (7,), "K", (3,)),
        kept(rlbench_data.Scalar, FLOAT, bytes(56)),
        kept(rlbench_data.Scalar, FLOAT),
        rlbench_data.NDArray((10**12,)),
        rlbench_data.DType("f8"),
        [rlbench_data.Demo(), 1],
        "seven numbers",
        "3",
        ["3", "1e3"],
        [None, 1],
        {1: 2},
        10**400,
        None,
    ],
)
def test_odd_arguments_of_allowed_names_make_no_numbers(value):
    with pytest.raises(RecordingError, match=r"^here: pose holds no numbers"):
        rlbench_data.read_numbers("here", "pose", value)


# ---- Damaged data sets ---------------------------------------------------------------------------

EPISODE = Path("rlbench/close_box/variation0/episodes/episode0")
FRAMES = EPISODE / "low_dim_obs.pkl"


def change(edit):
    """Changes the frames of the episode, as the file has them, by a function of all of them."""

    def damage():
        observations, _ = standin.make_observations(4)
        changed = edit(observations)
        FRAMES.write_bytes(pickle.dumps(standin.Demo(observations if changed is None else changed)))

    return damage


def set_misc(**values):
    def edit(observations):
        for observation in observations:
            observation.misc.update(values)

    return change(edit)


def set_values(frame, **values):
    return change(lambda observations: observations[frame].__dict__.update(values))


def image(name, pixels):
    return lambda: PIL.Image.fromarray(pixels).save(EPISODE / "front_depth" / name)


@pytest.mark.parametrize(
    "damage, message",
    [
        (lambda: os.truncate(FRAMES, 3000), "low_dim_obs.pkl: is damaged or no pickle"),
        (lambda: FRAMES.write_bytes(b""), "low_dim_obs.pkl: is damaged or no pickle"),
        (FRAMES.unlink, "low_dim_obs.pkl: is missing"),
        (lambda: FRAMES.write_bytes(pickle.dumps([1, 2])), "holds no frames of RLBench"),
        (change(lambda frames: []), "holds no frames of RLBench"),
        (change(lambda frames: [3]), "frame 0 does not say how its cameras stand"),
        (change(lambda frames: frames[:1]), "episode0: has a single frame"),
        (change(lambda frames: frames[:3]), "front_depth: has 4 images of 3 frames"),
        (set_values(2, misc=None), "frame 2 does not say how its cameras stand"),
        (set_values(1, misc={}), "1.png: does not say front_camera_near: record it again"),
        (set_values(1, gripper_pose=None), "gripper_pose holds no numbers"),
        (set_values(1, gripper_pose=np.zeros(7)), "gripper_pose of frame 1 has no unit quaternion"),
        (set_values(1, gripper_pose=np.ones((2, 7))), "has the shape (2, 7), not (7,)"),
        (set_values(1, gripper_open=None), "gripper_open holds no numbers"),
        (set_values(1, gripper_open=np.nan), "holds NaN or infinity in frame"),
        (set_misc(front_camera_intrinsics=np.eye(4)), "has the shape (4, 4), not (3, 3)"),
        (set_misc(front_camera_extrinsics="x"), "front_camera_extrinsics holds no numbers"),
        (set_misc(front_camera_far=0.001), "front_camera_near is 0.01, its far 0.001"),
        ((EPISODE / "front_depth" / "2.png").unlink, "has 3 images of 4 frames, and 2.png is none"),
        (image("4.png", np.zeros((4, 4, 3), np.uint8)), "front_depth: has 5 images of 4 frames"),
        (
            lambda: (EPISODE / "left_shoulder_depth").rename("elsewhere"),
            "left_shoulder_depth: is missing: record depth, too",
        ),
        (image("1.png", np.zeros((48, 64), np.uint8)), "1.png: is no depth in 24 bits (RGB)"),
        (image("1.png", np.zeros((96, 128, 3), np.uint8)), "has 128 x 96 pixels, but its intr"),
        (lambda: os.truncate(EPISODE / "front_depth" / "1.png", 99), "1.png: is damaged or no im"),
        (lambda: EPISODE.parents[1].rename("rlbench/close_box/x"), "is in no folder variation0"),
    ],
)
def test_a_damaged_data_set_is_refused_in_one_line(damage, message, capsys):
    standin.write_task("rlbench/close_box")
    damage()
    assert message in fails(convert, ["--import", "rlbench"], capsys)
    assert not Path("recordings").exists()


def test_what_only_other_formats_need_is_refused(capsys):
    standin.write_task("rlbench/close_box")
    Path("camera.json").write_text('{"depth_scale": 0.001}')
    argv = ["--import", "rlbench", "--camera", "camera.json"]
    assert "of --camera only the crop box is used" in fails(convert, argv, capsys)
    message = fails(convert, ["--import", "rlbench", "--color"], capsys)
    assert "no color: leave --color out" in message
    message = fails(convert, ["--import", "rlbench", "--skip", "3"], capsys)
    assert "has no episode 3 to --skip" in message


# ---- The environment -----------------------------------------------------------------------------


def make(task="close_box", **options):
    return rlbench_env.RLBench(**options).make(task, 128)


def test_without_rlbench_one_line_says_what_to_install(capsys, monkeypatch):
    real = rlbench_env.find_spec
    monkeypatch.setattr(rlbench_env, "find_spec", lambda n: None if n == "rlbench" else real(n))
    message = fails(simulator, ["--suite", "fs25"], capsys)
    assert "the package rlbench is not installed: install CoppeliaSim 4.1" in message


def test_where_rlbench_cannot_be_imported_one_line_says_why(monkeypatch):
    monkeypatch.setitem(sys.modules, "rlbench.environment", None)
    with pytest.raises(simulator.UserError, match=r"RLBench cannot be imported \(.*CoppeliaSim"):
        make().begin(0)


def test_the_suite_is_rlbenchs_own_split():
    base, novel = simulator.simulator_of("fs25").tasks("fs25")
    assert len(set(base)) == 25 and len(set(novel)) == 5 and not set(base) & set(novel)
    assert set(base) | set(novel) == set(rlbench_env.RLBench().instructions)
    words = {word for task in (*base, *novel) for word in task.split("_")}
    assert all(word == word.lower() and word.isalpha() for word in words)


def test_rlbench_is_launched_once_and_asked_for_what_is_used():
    env, other = make(), make("open_box")
    for environment in (env, env, other, other):
        environment.begin(3)
    launched = standin.Environment.launched
    assert launched.loaded == ["CloseBox", "OpenBox"]
    assert len(launched.action_mode.arguments) == 2
    config = launched.obs_config
    assert not config.wrist_camera.depth and not config.front_camera.mask
    assert config.front_camera.rgb and not config.left_shoulder_camera.rgb
    assert config.front_camera.image_size == (128, 128)
    assert other.task_environment.variation == 0
    with pytest.raises(RuntimeError, match="another episode has begun"):
        env.advance(np.zeros(7))


def test_the_environment_and_the_import_see_the_same_cloud():
    """Bit for bit: of the same depth images, by the same function."""
    env = make()
    env.begin(5)
    observation = env.observe()
    box = env.task_environment.box
    observations, depths = standin.make_observations(2, box=box)
    observations[0].gripper_pose, observations[0].gripper_open = env.task_environment.pose, 1.0
    standin.write_episode("rlbench/close_box/variation0/episodes/episode0", observations, depths)
    recording = imported("rlbench", "--instruction", "Close the box.", "--num-points", "128")
    recorded = recording["close_box"]
    assert observation["point_cloud"].dtype == observation["agent_pos"].dtype == np.float32
    assert distance_to_scene(observation["point_cloud"].astype(float), box).max() < 1e-5
    np.testing.assert_array_equal(recorded.points[0], np.float16(observation["point_cloud"]))
    np.testing.assert_array_equal(recorded.state[0], observation["agent_pos"])


def test_a_seed_decides_the_start():
    env, clouds = make(), []
    for seed in (7, 8, 7):
        env.begin(seed)
        clouds.append(env.observe()["point_cloud"])
    assert np.array_equal(clouds[0], clouds[2]) and not np.array_equal(clouds[0], clouds[1])
    env.begin(simulator.evaluation_seed(999, 99_999))  # the largest seed


def test_an_action_moves_the_gripper_and_touching_the_box_is_a_success():
    env = make()
    env.begin(1)
    goal = env.task_environment.box.mean(axis=0)
    turn = Rotation.from_rotvec([0.0, 0.0, 0.1])
    expected = turn * Rotation.from_quat(standin.DOWN)
    action = np.float32([*((goal - env.state()[:3]) / 2), 0, 0, 0.1, 0])
    assert env.advance(action) == (0.0, False, {"success": False})
    state = env.observe()["agent_pos"]
    assert (Rotation.from_rotvec(state[3:6]) * expected.inv()).magnitude() < 1e-5
    assert state[6] == 0  # closed
    action = np.float32([*(goal - env.state()[:3]), 0, 0, 0, 0.9])
    assert env.advance(action) == (1.0, True, {"success": True})
    np.testing.assert_allclose(env.observe()["agent_pos"][:3], goal, atol=1e-6)
    assert env.observe()["agent_pos"][6] == 1
    assert env.render().shape == (240, 240, 3) and env.render().dtype == np.uint8


def test_an_action_that_the_arm_cannot_do_ends_the_episode_as_a_failure():
    env = make()
    env.begin(1)
    before = env.observe()
    assert env.advance(np.array([2.0, 0, 0, 0, 0, 0, 1])) == (0.0, True, {"success": False})
    after = env.observe()
    assert all(np.array_equal(before[name], after[name]) for name in before)
    env.begin(1)
    assert env.advance(np.zeros(7))[1:] == (False, {"success": False})


def test_an_episode_is_truncated_after_its_steps():
    env = make(episode_steps=3)
    env.begin(1)
    assert [env.advance(np.zeros(7))[1] for _ in range(3)] == [False, False, True]
    with pytest.raises(simulator.UserError, match="has no expert: make its recording by"):
        env.expert_action()


def small_suite(monkeypatch, episodes=2):
    """A suite of two tasks, with recordings of episodes of 3, 4, 5 ... frames in data/."""
    monkeypatch.setattr(rlbench_env, "BASE", ("close_box",))
    monkeypatch.setattr(rlbench_env, "NOVEL", ("open_box",))
    for task in ("close_box", "open_box"):
        standin.write_task(f"rlbench/{task}", episodes=episodes, frames=3)
    imported("rlbench")


def test_imported_recordings_are_what_the_suite_trains_on(monkeypatch, capsys):
    small_suite(monkeypatch)
    suite = simulator.simulator_of("fs25")
    paths = simulator.collect(suite, ["close_box", "open_box"], "data", episodes=2, seed=0)
    assert list(paths) == ["close_box", "open_box"]
    simulator.main("--suite fs25 --episodes 2".split())
    assert "| close_box | 2        |" in capsys.readouterr().out

    Path("data/open_box.npz").unlink()
    message = fails(simulator, "--suite fs25 --episodes 2".split(), capsys)
    assert "data/open_box.npz is missing or holds fewer than 2 demonstrations: make it" in message
    assert "rlbench-generate-dataset" in message and "convert.py --import FOLDER" in message
    message = fails(simulator, "--suite fs25 --task close_box".split(), capsys)
    assert "data/close_box.npz is missing or holds fewer than 10 demonstrations" in message


def test_a_recording_that_was_imported_otherwise_is_refused(monkeypatch, capsys):
    small_suite(monkeypatch)
    Path("data/close_box.npz").unlink()
    imported("rlbench/close_box", "--wrist", "--num-points", "64")
    message = fails(simulator, "--suite fs25 --episodes 2".split(), capsys)
    assert "data/close_box.npz was recorded with another cameras, num_points" in message


class Repeats:
    """In place of a policy: it repeats a demonstration's first action, and tells which that was."""

    config = replace(PRESETS["tiny"], state_dim=7, action_dim=7, num_points=64, demo_stride=1)

    def __init__(self):
        self.normalizer = type("", (), {"action_scale": torch.zeros(1)})
        self.held = []

    def encode_demo(self, text, demo_points, demo_state, demo_action):
        self.held.append(demo_action.shape[1])
        return (demo_action[:, :1],)

    def sample_actions(self, points, state, context, generator):
        assert points.shape[2:] == (64, 3) and state.shape[2:] == (7,)
        return context[0].expand(len(points), self.config.n_action_steps, 7)


def test_all_rollouts_of_a_task_hold_one_demonstration_and_are_played_one_at_a_time(monkeypatch):
    small_suite(monkeypatch, episodes=4)  # of different lengths, by which they are told apart
    policy = Repeats()
    monkeypatch.setattr(evaluate, "load_trained", lambda *_, **__: (policy, {"arguments": {}}))
    jobs = []

    def run_here(job, listed, **_):
        jobs.extend(listed)
        return [job(**arguments) for arguments in listed]

    monkeypatch.setattr(evaluate, "run_jobs", run_here)
    held = {}
    for seed in range(3):
        policy.held.clear()
        outcomes = evaluate.evaluate_checkpoint(
            "x.pt",
            rlbench_env.RLBench(episode_steps=4),
            {task: Path(f"data/{task}.npz") for task in ("close_box", "open_box")},
            {task: torch.zeros(512) for task in ("close_box", "open_box")},
            episodes=3,
            seed=seed,
        )
        held[seed] = list(policy.held)
        assert len(held[seed]) == 6 and len(set(held[seed][:3])) == 1
    assert len({tuple(of) for of in held.values()}) > 1  # another seed draws another
    assert all(len(job["seeds"]) == 1 for job in jobs)
    assert {task: len(of) for task, of in outcomes.any_step.items()} == {
        "close_box": 3,
        "open_box": 3,
    }
    with pytest.raises(simulator.UserError, match="does not say the seeds of its episodes"):
        evaluate.evaluate_checkpoint(
            "x.pt",
            rlbench_env.RLBench(),
            {"close_box": Path("data/close_box.npz")},
            {"close_box": torch.zeros(512)},
            known_goals=True,
        )
