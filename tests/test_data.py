"""Tests of data.py against naive implementations, and with files that are wrong in many ways."""

import errno
import json
import os
import re
import stat
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import data
from data import Demonstrations, RecordingError, WindowSampler
from model import PolicyConfig

SIZES = PolicyConfig(num_points=16)
COLORED = SimpleNamespace(**{**asdict(SIZES), "point_dim": 6})


def recording(lengths=(200, 30), points=16, seed=0):
    """Small demonstrations of random numbers."""
    rng = np.random.default_rng(seed)
    frames = sum(lengths)
    return Demonstrations(
        task="reach",
        instruction="Move.",
        points=rng.normal(size=(frames, points, 3)).astype(np.float16),
        state=rng.normal(size=(frames, 9)).astype(np.float32),
        action=rng.uniform(-1, 1, size=(frames, 4)).astype(np.float32),
        episode_ends=np.cumsum(lengths),
        meta={"made_by": "a test"},
    )


def colored(recorded, seed=0):
    """The same demonstrations with a colour, three numbers from 0 to 1, for each point."""
    colors = np.random.default_rng(seed).uniform(0, 1, recorded.points.shape)
    points = np.concatenate([recorded.points, colors.astype(np.float16)], axis=-1)
    return replace(recorded, points=points)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


# ---- Farthest point sampling ---------------------------------------------------------------------


def naive_sample(points, n, first):
    """Farthest point sampling, beginning with the point `first`."""
    chosen = [int(((points - first) ** 2).sum(axis=1).argmin())]
    distance = ((points - points[chosen[0]]) ** 2).sum(axis=1)
    for _ in range(n - 1):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
    return points[chosen]


def coverage(points, sample):
    """The greatest distance from a point to the sample."""
    return np.sqrt(((points[:, None] - sample[None]) ** 2).sum(axis=-1).min(axis=1)).max()


def ball(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)


def surfaces(count, seed=0):
    """Points on a thin rod and on a small sphere beside it: as uneven as what a camera sees."""
    rng = np.random.default_rng(seed)
    rod = rng.uniform((0, 0, 0), (0.02, 0.02, 0.5), (count // 2, 3))
    sphere = rng.normal(size=(count - count // 2, 3))
    sphere = (0.3, 0.4, 0.1) + 0.02 * sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    return np.concatenate([rod, sphere]).astype(np.float32)


@pytest.mark.parametrize("n", [1, 64, 300])
@pytest.mark.parametrize("cloud", [ball, surfaces])
def test_farthest_points_cover_as_a_naive_implementation(cloud, n):
    points = cloud(700)
    ours = data.farthest_point_sample(points, n)
    naive = naive_sample(points, n, ours[0])
    assert ours.shape == (n, 3)
    assert coverage(points, ours) == pytest.approx(coverage(points, naive), rel=0.01)


def test_the_first_points_of_a_sample_are_a_sample():
    points = ball(900)
    many = data.farthest_point_sample(points, 512)
    np.testing.assert_array_equal(many[:128], data.farthest_point_sample(points, 128))


@pytest.mark.parametrize("count", [1, 2, 7, 8, 100])
def test_a_small_cloud_is_repeated_and_keeps_all_its_points(count):
    points = ball(count)
    sample = data.farthest_point_sample(points, 250)
    assert sample.shape == (250, 3) and {tuple(p) for p in sample} == {tuple(p) for p in points}
    np.testing.assert_array_equal(sample[:count], sample[count : 2 * count])


def test_an_empty_cloud_is_an_error():
    for cloud in (ball(0), np.zeros((0, 6), np.float32)):
        with pytest.raises(ValueError, match="empty"):
            data.farthest_point_sample(cloud, 8)


def test_distances_are_those_of_positions_and_points_keep_their_features():
    rng = np.random.default_rng(0)
    for count in (5, 700):
        points = ball(count)
        loud = 100 * rng.normal(size=(count, 3)).astype(np.float32)  # farther apart than the points
        sample = data.farthest_point_sample(np.concatenate([points, loud], axis=1), 64)
        np.testing.assert_array_equal(sample[:, :3], data.farthest_point_sample(points, 64))
        feature_of = {tuple(point): tuple(feature) for point, feature in zip(points, loud)}
        assert all(feature_of[tuple(row[:3])] == tuple(row[3:]) for row in sample)


# ---- Files ---------------------------------------------------------------------------------------


def test_a_file_gives_back_what_was_saved(tmp_path):
    saved = recording((50, 7, 120))
    data.save_demonstrations(tmp_path / "new" / "reach.npz", saved)
    loaded = data.load_demonstrations(tmp_path / "new" / "reach.npz")
    for part in ("task", "instruction", "meta"):
        assert getattr(loaded, part) == getattr(saved, part)
    for part in ("points", "state", "action", "episode_ends"):
        np.testing.assert_array_equal(getattr(loaded, part), getattr(saved, part))
        assert getattr(loaded, part).dtype == getattr(saved, part).dtype
    assert len(loaded) == 3 and loaded.episode(1) == slice(50, 57)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["reach.npz"]


def test_points_with_colors_are_saved_and_read(tmp_path):
    saved = colored(recording())
    data.save_demonstrations(tmp_path / "reach.npz", saved)
    np.testing.assert_array_equal(
        data.load_demonstrations(tmp_path / "reach.npz").points, saved.points
    )


def test_the_first_episodes_are_taken():
    recorded = recording((50, 7, 120))
    taken = recorded.take(2)
    assert len(taken) == 2 and len(taken.points) == len(taken.state) == len(taken.action) == 57
    assert recorded.take(None) is recorded
    for n in (0, 4):
        message = f"{n} demonstrations of reach asked for, there are 3"
        with pytest.raises(RecordingError, match=message):
            recorded.take(n)


def test_the_last_episodes_are_held_out():
    recorded = replace(recording((30, 20, 40, 25)), meta={"success_frames": [1, 2, 3, 4]}).take(3)
    kept, heldout = data.hold_out(recorded, 2)
    assert kept.episode_ends.tolist() == [30] and heldout.episode_ends.tolist() == [20, 60]
    for part in ("points", "state", "action"):
        np.testing.assert_array_equal(getattr(kept, part), getattr(recorded, part)[:30])
        np.testing.assert_array_equal(getattr(heldout, part), getattr(recorded, part)[30:])
    assert heldout.meta["success_frames"] == [2, 3]  # of its own episodes, and of no more
    assert kept.meta["success_frames"] == [1] and recorded.meta["success_frames"] == [1, 2, 3]
    for part in (recorded, kept, heldout):
        part.check()


def test_an_episode_is_counted_from_either_end():
    recorded = recording((50, 7, 120))
    assert recorded.episode(0) == recorded.episode(-3) == slice(0, 50)
    assert recorded.episode(-1) == recorded.episode(2) == slice(57, 177)
    for index in (3, -4):
        with pytest.raises(IndexError):
            recorded.episode(index)


def test_no_episode_or_all_but_one_can_be_held_out():
    recorded = recording((50, 7, 120))
    kept, heldout = data.hold_out(recorded, 0)
    assert len(kept) == 3 and heldout is None
    assert [len(part) for part in data.hold_out(recorded, 2)] == [1, 2]
    for n in (3, 4, -1):
        with pytest.raises(RecordingError, match=f"reach: {n} of 3 episodes cannot be held out"):
            data.hold_out(recorded, n)


def test_a_failing_save_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "reach.npz"
    data.save_demonstrations(path, recording())
    before = path.read_bytes()

    def full_disk(file, **arrays):
        file.write(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr(np, "savez", full_disk)
    with pytest.raises(OSError, match="No space"):
        data.save_demonstrations(path, recording(seed=1))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_two_writers_of_one_file_do_not_meet(tmp_path):
    """One process may write while another does, with the same number in another container."""
    path, seen = tmp_path / "reach.txt", []

    def slow(temporary):
        temporary.write_text("first")
        data.write_atomically(path, quick)
        seen.append(path.read_text())
        assert temporary.read_text() == "first"

    def quick(temporary):
        temporary.write_text("second")

    data.write_atomically(path, slow)
    assert seen == ["second"] and path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


def test_writing_removes_nothing_that_is_of_others(tmp_path):
    for name in (f".{os.getpid()}.a.npz", ".1.a.npz", ".2024-11-02.notes.md", ".unfinished-x"):
        (tmp_path / name).write_text("mine")
    before = {path: path.read_text() for path in tmp_path.iterdir()}
    data.save_demonstrations(tmp_path / "a.npz", recording())
    (tmp_path / "a.npz").unlink()
    assert {path: path.read_text() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("umask", [0o022, 0o077, 0o002])
def test_a_file_has_the_mode_that_open_gives(tmp_path, umask):
    previous = os.umask(umask)
    try:
        data.write_text(tmp_path / "written.txt", "text")
        (tmp_path / "opened.txt").write_text("text")
    finally:
        os.umask(previous)
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()}
    assert modes["written.txt"] == modes["opened.txt"] == 0o666 & ~umask


def test_a_temporary_file_keeps_its_suffix_and_is_on_the_same_disk(tmp_path):
    """numpy and matplotlib go by the suffix; between disks nothing can be renamed."""
    folders = []

    def write(temporary):
        folders.append(temporary.parent.parent)
        np.savez(temporary, x=np.arange(3))  # appends .npz where it is missing

    data.write_atomically(tmp_path / "a.npz", write)
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"] and folders == [tmp_path]


UNSAVABLE = [
    ({"points": np.full((30, 16, 3), np.nan, np.float16)}, "points holds NaN"),
    ({"points": np.full((30, 16, 3), 900, np.float16)}, "write them in metres"),
    ({"meta": {"positions_in_state": np.int64(4)}}, "positions_in_state is 4, a state has 9 numb"),
    ({"meta": {"made_by": b"me"}}, "meta must hold what JSON can, made_by: bytes"),
    ({"meta": {("made", "by"): "me"}}, r"the names in meta must be text, not \('made', 'by'\)"),
    ({"meta": {"simulator": 3}}, "simulator must be a name, not 3"),
]


@pytest.mark.parametrize("parts, message", UNSAVABLE)
def test_what_could_not_be_read_again_is_not_saved(tmp_path, parts, message):
    demonstrations = replace(recording((20, 10)), **parts)
    with pytest.raises(RecordingError, match=message) as caught:
        data.save_demonstrations(tmp_path / "reach.npz", demonstrations)
    assert "\n" not in str(caught.value) and "reach.npz" in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "parts, message",
    [
        ({"task": b"reach"}, "task must be text .* not bytes"),
        ({"instruction": b"Move."}, "instruction must be text .* not bytes"),
        ({"instruction": None}, "instruction must be text .* not NoneType"),
        ({"instruction": ["Move."]}, "instruction must be text .* not list"),
        ({"state": [[0.0] * 9] * 30}, "state must be a NumPy array, not list"),
        ({"action": torch.zeros(30, 4)}, "action must be a NumPy array, not Tensor"),
        ({"episode_ends": [20, 30]}, "episode_ends must be a NumPy array, not list"),
        ({"meta": None}, "meta must be a dict, not NoneType"),
    ],
)
def test_a_part_of_another_type_is_refused_where_the_recording_is_made(parts, message):
    with pytest.raises(RecordingError, match=message):
        replace(recording((20, 10)), **parts)


def test_numbers_of_numpy_in_meta_are_saved_as_numbers(tmp_path):
    meta = {"positions_in_state": np.int64(1), "success_frames": np.array([3, 5])}
    saved = replace(recording((20, 10)), meta=meta)
    data.save_demonstrations(tmp_path / "reach.npz", saved)
    found = data.load_demonstrations(tmp_path / "reach.npz").meta
    assert found == {"positions_in_state": 1, "success_frames": [3, 5]}
    assert WindowSampler(saved, SIZES, augment=True).augment


def test_a_link_stays_a_link_and_a_file_keeps_its_mode(tmp_path):
    target, link = tmp_path / "shared" / "reach.npz", tmp_path / "link.npz"
    target.parent.mkdir()
    link.symlink_to(target)
    data.save_demonstrations(link, recording())
    target.chmod(0o660)
    data.save_demonstrations(link, recording(seed=1))
    assert link.is_symlink() and stat.S_IMODE(target.stat().st_mode) == 0o660
    np.testing.assert_array_equal(data.load_demonstrations(target).state, recording(seed=1).state)


def with_feature(value):
    """Clouds of one colour channel, whose last point's is another."""
    points = np.full((30, 16, 4), 0.5, np.float16)
    points[-1, -1, 3] = value
    return points


def with_empty_cloud(points):
    """Points of frame 12 as an empty cloud is padded; their features stay as they are."""
    points[12, :, :3] = 0
    return points


NAN = np.full((30, 16, 3), np.nan, np.float16)
NO_FRAMES = {
    "points": NAN[:0],
    "state": np.zeros((0, 9), np.float32),
    "action": np.zeros((0, 4), np.float32),
    "episode_ends": np.array([], np.int64),
}


def meta(**changes):
    return {"meta": json.dumps(changes)}


# What replaces parts of a good file of two episodes, 20 and 10 frames, and what is said of it.
BAD_PARTS = [
    ({"action": None}, "lacks action"),
    ({"points": NAN}, "points holds NaN, .* in 30 of 30 frames, first in frame 0: leave such poi"),
    ({"state": np.full((30, 9), np.inf, np.float32)}, "state holds NaN"),
    ({"points": NAN[..., :2]}, "points must be"),
    ({"points": with_feature(np.nan)}, "points holds NaN, .* in 1 of 30 frames, first in frame 29"),
    ({"points": with_feature(255)}, "features of points reach 255: .* write colours from 0 to 1"),
    ({"points": with_feature(-2)}, "features of points reach 2"),
    ({"points": with_empty_cloud(np.zeros((30, 16, 3)))}, "all points of frame 0 are at 0, 0, 0"),
    ({"points": with_empty_cloud(np.ones((30, 16, 3)))}, "all points of frame 12 are at 0, 0, 0"),
    ({"points": with_empty_cloud(np.ones((30, 16, 6)))}, "all points of frame 12 are at 0, 0, 0"),
    ({"instruction": b"Move."}, r"instruction must be text \(str\), not \|S5"),
    ({"task": np.array(["reach"])}, r"task must be text \(str\), not <U5 \(1,\)"),
    ({"instruction": np.array(3)}, r"instruction must be text \(str\), not int64"),
    ({"meta": b"{}"}, r"meta must be text \(str\), not \|S2"),
    ({"meta": "[1, 2]"}, "meta must be a dict, not list"),
    ({"meta": "null"}, "meta must be a dict, not NoneType"),
    ({"points": np.zeros((30, 0, 3), np.float16)}, "points must be"),
    ({"action": np.zeros(30, np.float32)}, "action must be 2-dimensional"),
    ({"action": np.zeros((30, 4), np.int64)}, "action must be 2-dimensional"),
    ({"state": np.zeros((29, 9), np.float32)}, "lengths differ.*'state': 29"),
    ({"episode_ends": np.array([20, 31])}, "lengths differ.*'episodes': 31"),
    ({"episode_ends": np.array([20, 20, 30])}, "growing whole numbers"),
    ({"episode_ends": np.array([20.0, 30.0])}, "growing whole numbers"),
    ({"episode_ends": np.array([[20, 30]])}, "growing whole numbers"),
    ({"episode_ends": np.array([0, 30])}, "growing whole numbers"),
    ({"episode_ends": np.array([40, 30], np.uint64)}, "growing whole numbers"),
    (NO_FRAMES, "holds no episodes"),
    ({"action": np.zeros((30, 4), ">f4")}, "action must be 2-dimensional"),
    ({"action": np.zeros((30, 4), np.longdouble)}, "action must be 2-dimensional"),
    ({"state": np.full((30, 9), 1e35)}, "state holds NaN, infinite or huge numbers"),
    ({"points": np.full((30, 16, 3), 900, np.float16)}, "write them in metres"),
    ({"task": "re\0ach"}, "is no name"),
    *(
        (meta(workspace=wrong), "workspace must be two corners")
        for wrong in (
            "x",
            [[0, 0, 0], [1, 1]],
            [[0, 0, None], [1, 1, 1]],
            [[0, 0, "x"], [1, 1, 1]],
            [["0", "0", "0"], ["1", "1", "1"]],
            [[False, False, False], [True, True, True]],
            [[0, 0, 0], [1, 1, 10**400]],
        )
    ),
    ({"state": np.array([None, 1], dtype=object)}, "is damaged or no .*: Object arrays"),
    ({"meta": "not json"}, "meta is no JSON: Expecting"),
    ({"meta": "[" * 100_000}, "meta is no JSON"),
    *(
        (meta(success_frames=wrong), "success_frames must")
        for wrong in ([1], [1, 2, 3], [1, "2"], [1, -1], [1, 30], 1)
    ),
    *((meta(positions_in_state=wrong), "positions_in_state is") for wrong in (4, -1, "3", True)),
    ({"action": np.zeros((30, 2), np.float32), **meta(positions_in_state=1)}, "a displacement"),
]


@pytest.mark.parametrize("parts, message", BAD_PARTS)
def test_a_file_with_bad_contents_is_refused_in_one_line(tmp_path, parts, message):
    path = tmp_path / "reach.npz"
    arrays = vars(recording((20, 10))) | {"meta": "{}"} | parts
    np.savez(path, **{part: value for part, value in arrays.items() if value is not None})
    with pytest.raises(RecordingError, match=message) as caught:
        data.load_demonstrations(path)
    assert "\n" not in str(caught.value) and "reach.npz" in str(caught.value)


def test_a_file_that_may_not_be_read_is_refused_in_one_line(tmp_path, monkeypatch):
    def forbidden(_):
        raise PermissionError(errno.EACCES, "Permission denied")

    data.save_demonstrations(tmp_path / "reach.npz", recording())
    monkeypatch.setattr(data.zipfile, "is_zipfile", forbidden)  # root may read any file
    with pytest.raises(RecordingError, match=r"reach\.npz cannot be read: Permission denied"):
        data.load_demonstrations(tmp_path / "reach.npz")


def test_a_missing_truncated_or_foreign_file_is_refused_in_one_line(tmp_path):
    path = tmp_path / "reach.npz"
    data.save_demonstrations(path, recording())
    whole = path.read_bytes()
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 255
    for content, message in [
        (None, r"missing: collect it with `python simulator.py`"),
        (whole[: len(whole) // 2], "truncated"),
        (b"", "truncated"),
        (b"task,points\n1,2\n", "no .npz file"),
        (bytes(damaged), "damaged"),
    ]:
        path.unlink(missing_ok=True)
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(RecordingError, match=message) as caught:
            data.load_demonstrations(path)
        assert "\n" not in str(caught.value)


# ---- Suspicions ----------------------------------------------------------------------------------


def moved_hand(episodes=6, length=40, seed=0):
    """A good recording: a hand goes through a cloud, and an action is the next change of it."""
    rng = np.random.default_rng(seed)
    frames = episodes * length
    action = rng.normal(scale=0.01, size=(episodes, length, 7)).cumsum(axis=1) / 10
    start = rng.uniform(-0.3, 0.3, size=(episodes, 1, 7))
    state = np.concatenate([start, start + action.cumsum(axis=1)[:, :-1]], axis=1)
    return Demonstrations(
        task="stir",
        instruction="Stir.",
        points=rng.uniform(-0.5, 0.5, size=(frames, 16, 3)).astype(np.float16),
        state=state.reshape(frames, 7).astype(np.float32),
        action=action.reshape(frames, 7).astype(np.float32),
        episode_ends=np.arange(length, frames + 1, length),
        meta={"positions_in_state": 1},
    )


@pytest.mark.parametrize("absolute", [False, True])
def test_a_good_recording_is_not_suspected(absolute):
    good = moved_hand()
    action = good.state + good.action if absolute else good.action
    assert data.suspicions(replace(good, action=action)) == []
    assert data.suspicions(replace(good, meta={})) == []
    assert data.suspicions(recording((1,))) == []


def test_recordings_of_meta_world_are_not_suspected(recorded):
    files = sorted(recorded.glob("*.npz"))
    assert len(files) == 4
    assert not any(data.suspicions(data.load_demonstrations(file)) for file in files)


def spiked(good):
    state = good.state.copy()
    state[100, 3] = 1e6
    return {"state": state}


@pytest.mark.parametrize(
    "fault, message",
    [
        (spiked, r"state 3 is 1e\+06 in frame 100 \(episode 2\), while 98 percent .* from -0"),
        (lambda good: {"state": 1000 * good.state}, "position 0 of the state lies far .* in frame"),
        (lambda good: {"points": good.points * np.float16(100)}, "the points span 1.* in metres"),
        (lambda good: {"points": good.points / np.float16(100)}, "the points span 0.0"),
        (lambda good: {"action": np.roll(good.action, 1, axis=0)}, "state 1 frame earlier"),
        (lambda good: {"action": np.roll(good.action, -1, axis=0)}, "state 1 frame later"),
        (
            lambda good: {"action": np.roll(good.state + good.action, 1, axis=0)},
            "state 1 frame earlier",
        ),
        (
            lambda good: {"episode_ends": np.array([41, 81, 121, 161, 201, 240])},
            r"jumps from frame 39 to 40, .* from 40 to 41, where episode 0 ends \(5 .* 1 too large",
        ),
        (
            lambda good: {"episode_ends": np.array([39, 79, 119, 159, 199, 240])},
            "jumps from frame 39 to 40, but not from 38 to 39, where .* 1 too small",
        ),
    ],
)
def test_what_looks_wrong_is_said_in_one_line(fault, message):
    good = moved_hand()
    wrong = replace(good, **fault(good))
    wrong.check()
    (line,) = data.suspicions(wrong)
    assert re.search(message, line) and "\n" not in line


def test_an_end_that_is_suspected_twice_is_counted_once():
    wrong = moved_hand(episodes=2)
    wrong.state[38] += 10  # there and back again, one and two frames before the first episode ends
    (line,) = data.suspect_episode_ends(wrong)
    assert "(1 such ends in all)" in line


# ---- Windows -------------------------------------------------------------------------------------


def test_200_frames_give_193_windows_and_short_episodes_at_least_one():
    for lengths, windows in [((200,), 193), ((200, 200), 386), ((1, 5), 2), ((16,), 9)]:
        assert len(WindowSampler(recording(lengths), SIZES)) == windows
    one_step = replace(SIZES, horizon=4, n_obs_steps=1, n_action_steps=1)
    assert len(WindowSampler(recording((50,)), one_step)) == 47


def test_windows_equal_naive_slicing_of_the_padded_episodes():
    recorded = recording((40, 3, 25))
    sampler = WindowSampler(recorded, replace(SIZES, num_points=8))
    expected = []
    for index in range(3):
        frames = list(range(recorded.episode_ends[index]))[recorded.episode(index)]
        padded = [frames[0]] + frames + [frames[-1]] * 7
        windows = [padded[start : start + 16] for start in range(len(padded) - 15)]
        expected += windows or [(padded + [frames[-1]] * 16)[:16]]
    assert len(sampler) == len(expected)
    batch = sampler.gather(torch.arange(len(sampler)))
    for window, frames in enumerate(expected):
        points = recorded.points[frames[:2], :8].astype(np.float32)
        np.testing.assert_array_equal(batch["points"][window].numpy(), points)
        np.testing.assert_array_equal(batch["state"][window].numpy(), recorded.state[frames[:2]])
        np.testing.assert_array_equal(batch["action"][window].numpy(), recorded.action[frames])


def test_windows_begin_up_to_so_many_frames_after_the_first_success():
    recorded = replace(recording((40, 30)), meta={"success_frames": [10, 28]})
    every = WindowSampler(recorded, SIZES)
    some = WindowSampler(recorded, SIZES, after_success=5)
    last = (40 - 16 + 7, 30 - 16 + 7)  # where the last window of each whole episode begins
    assert len(every) == last[0] + 2 + last[1] + 2  # one begins a frame before the episode
    assert len(some) == 15 + 2 + last[1] + 2  # the second success comes after the last window
    kept = torch.cat([every.windows[:17], every.windows[last[0] + 2 :]])
    assert torch.equal(some.windows, kept)
    assert len(WindowSampler(recorded.take(1), SIZES, after_success=5)) == 17
    untold = replace(recorded, meta={})
    assert len(WindowSampler(untold, SIZES, after_success=5)) == len(every)


def test_late_windows_are_drawn_as_often_as_asked_for_and_come_in_a_random_order():
    recorded = replace(recording((40, 30)), meta={"success_frames": [10, 28]})
    sampler = WindowSampler(recorded, SIZES, after_success=5, late_fraction=0.25)
    every = WindowSampler(recorded, SIZES)
    assert torch.equal(sampler.windows, every.windows)
    starts = sampler.windows[:, 0]
    assert torch.equal(sampler.late, (starts > 15) & (sampler.episode_of == 0))

    late_starts = torch.arange(
        16, 40
    )  # of the first episode, whose windows are told by their frames
    places, n_late = [], 0
    for seed in range(400):
        chosen = sampler.sample(8, seeded(seed))["action"][:, 0]  # (8, A)
        is_late = (chosen[:, None] == sampler.action[late_starts]).all(-1).any(-1)  # (8,)
        n_late += int(is_late.sum())
        places += torch.nonzero(is_late).flatten().tolist()
    assert n_late == pytest.approx(0.25 * 8 * 400, rel=0.1)
    assert np.bincount(places, minlength=8).min() > 0.7 * n_late / 8  # support and query alike


def test_without_late_windows_all_that_are_drawn_are_early():
    recorded = replace(recording((40, 30)), meta={"success_frames": [39, 29]})
    sampler = WindowSampler(recorded, SIZES, after_success=5, late_fraction=0.5)
    assert not sampler.late.any() and len(sampler.sample(8, seeded(0))["action"]) == 8


def test_a_batch_is_drawn_in_an_order_that_never_changes():
    """Results belong to a seed: first the reference, then the windows of the other episodes."""
    sampler = WindowSampler(recording((40, 30, 50)), SIZES)
    for n in (5, 200):  # fewer and more than there are
        generator = seeded(n)
        reference = int(torch.randint(3, (1,), generator=generator))
        others = torch.tensor([i for i in range(99) if sampler.episode_of[i] != reference])
        if n <= len(others):
            chosen = others[torch.randperm(len(others), generator=generator)[:n]]
        else:
            chosen = others[torch.randint(len(others), (n,), generator=generator)]
        expected = {**sampler.gather(chosen), **sampler.demonstration(reference)}

        before = torch.get_rng_state()
        batch = sampler.batch(n, seeded(n))
        assert batch.keys() == expected.keys()
        assert all(torch.equal(batch[name], x) for name, x in expected.items())
        assert torch.equal(torch.get_rng_state(), before)  # nothing of the global generator


def test_sampling_is_float32_repeatable_and_without_repetition():
    sampler = WindowSampler(recording(), SIZES)
    first, second = (sampler.sample(100, seeded()) for _ in range(2))
    shapes = {"points": (100, 2, 16, 3), "state": (100, 2, 9), "action": (100, 16, 4)}
    assert {name: x.shape for name, x in first.items()} == shapes
    assert all(x.dtype == torch.float32 for x in first.values())
    assert all(torch.equal(x, second[name]) for name, x in first.items())
    whole = sampler.sample(len(sampler), torch.Generator())["action"]
    assert len(torch.unique(whole, dim=0)) == len(sampler)
    assert len(sampler.sample(1000, torch.Generator())["action"]) == 1000
    assert sampler.points.dtype == torch.float16 and len(sampler.points) == 230  # held once


def test_a_demonstration_is_one_whole_episode_at_the_stride():
    recorded = recording((40, 25))
    sampler = WindowSampler(recorded, replace(SIZES, demo_stride=8))
    demo = sampler.demonstration(1)
    np.testing.assert_array_equal(demo["demo_action"][0].numpy(), recorded.action[40:65:8])
    assert {name: x.shape for name, x in demo.items()} == {
        "demo_points": (1, 4, 16, 3),
        "demo_state": (1, 4, 9),
        "demo_action": (1, 4, 4),
    }
    assert all(x.dtype == torch.float32 for x in demo.values())
    assert {sampler.sample_episode(seeded(seed)) for seed in range(20)} == {0, 1}


def test_no_window_is_from_the_reference_demonstration_unless_it_is_the_only_one():
    recorded = recording((40, 40, 40))
    recorded.state[:] = np.repeat([0, 1, 2], 40)[:, None]
    sampler = WindowSampler(recorded, SIZES)
    for seed in range(10):
        batch = sampler.batch(30, seeded(seed))
        assert not (batch["state"] == batch["demo_state"][0, 0]).any()
        assert len(batch["state"].unique()) == 2
    alone = WindowSampler(recorded.take(1), SIZES).batch(8, seeded())
    assert (alone["state"] == alone["demo_state"][0, 0]).all()


@pytest.mark.parametrize("episodes", [3, 4, 7])
def test_support_windows_are_of_other_episodes_than_query_windows(episodes):
    recorded = recording((40,) * episodes)
    recorded.state[:] = np.repeat(np.arange(episodes), 40)[:, None]
    sampler = WindowSampler(recorded, SIZES)
    used = []  # sets of episodes: of the reference, of support and of query windows
    for seed in range(40):
        batch = sampler.batch(60, seeded(seed), support=25)
        of_window = batch["state"][:, 0, 0].tolist()
        used.append(({batch["demo_state"][0, 0, 0].item()}, {*of_window[:25]}, {*of_window[25:]}))
    for reference, support, query in used:
        assert not reference & support and not reference & query and not support & query
    for place in range(3):  # each episode takes each place
        assert len(set().union(*(sets[place] for sets in used))) == episodes
    two = WindowSampler(recorded.take(2), SIZES).batch(60, seeded(), support=25)
    assert len(two["state"].unique()) == 1  # nothing is left to choose


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"num_points": 32}, "reach has 16 points a cloud, the policy 32: use recordings"),
        ({"state_dim": 7}, "reach has 9 numbers a state, the policy 7: use recordings"),
        ({"action_dim": 7}, "reach has 4 numbers an action, the policy 7: use recordings"),
        ({"point_dim": 6}, "reach has 3 numbers a point, the policy 6: use recordings"),
        ({"demo_positions": 100}, "has 200 frames .* the policy 100 positions"),
    ],
)
def test_demonstrations_that_do_not_fit_the_policy_are_refused_with_both_numbers(changes, message):
    with pytest.raises(RecordingError, match=message):
        WindowSampler(recording(), SimpleNamespace(**{**asdict(SIZES), **changes}))


def test_points_with_colors_reach_windows_and_demonstrations():
    recorded = colored(recording((40, 30)))
    with pytest.raises(RecordingError, match="has 6 numbers a point, the policy 3"):
        WindowSampler(recorded, SIZES)
    sampler = WindowSampler(recorded, COLORED)
    batch = sampler.batch(8, seeded())
    assert batch["points"].shape == (8, 2, 16, 6) and batch["demo_points"].shape[2:] == (16, 6)
    known = {tuple(row) for row in recorded.points.reshape(-1, 6).astype(np.float32).tolist()}
    assert {tuple(row) for row in batch["points"].flatten(0, 2).tolist()} <= known


def test_the_length_of_a_demonstration_matters_only_where_it_is_encoded_in_order():
    WindowSampler(recording(), replace(SIZES, demo_positions=100, demo_stride=2))
    WindowSampler(recording(), replace(SIZES, demo_positions=100, demo_encoder="none"))


# ---- Augmentation --------------------------------------------------------------------------------


def test_scenes_are_moved_elsewhere_and_stay_consistent():
    recorded = recording((40, 30))
    rng = np.random.default_rng(0)
    recorded.action[:] = rng.uniform(-0.5, 0.5, recorded.action.shape)
    displacement = recorded.action[:, :3] / 100  # an action is 100 times the hand's displacement
    hand = np.cumsum(displacement, axis=0) - displacement
    recorded.state[:, :6] = np.tile(hand, 2)
    carried = rng.uniform(-0.05, 0.05, (1, *recorded.points.shape[1:]))
    recorded.points[:] = hand[:, None] + carried
    recorded.meta["positions_in_state"] = 2
    plain, moved = (WindowSampler(recorded, SIZES, augment=on) for on in (False, True))
    before, after = (sampler.batch(12, seeded()) for sampler in (plain, moved))
    assert {k: x.shape for k, x in before.items()} == {k: x.shape for k, x in after.items()}

    for prefix in ("", "demo_"):
        points, state, action = (after[prefix + name] for name in ("points", "state", "action"))
        for part in (slice(0, 3), slice(3, 6)):
            way = 100 * state[:, :-1, part].diff(dim=1)
            asked = action[:, : state.shape[1] - 2, :3]
            torch.testing.assert_close(way, asked, atol=1e-3, rtol=0)
        offsets = points - state[:, :, None, :3]  # one in all frames of a scene, up to float16
        torch.testing.assert_close(offsets, offsets[:, :1].expand_as(offsets), atol=5e-3, rtol=0)
        assert torch.equal(state[..., 6:], before[prefix + "state"][..., 6:])
        assert torch.equal(action[..., 3:], before[prefix + "action"][..., 3:])
    shifts = (after["state"] - before["state"])[:, 0, :3]
    demo_shift = (after["demo_state"] - before["demo_state"])[:, 0, :3]
    shifts = torch.cat([shifts, demo_shift])
    assert len(torch.unique(shifts, dim=0)) == 13  # each window and the demonstration its own
    assert (shifts != 0).any(dim=1).all() and 0.02 < shifts.abs().max() < 0.3

    recorded.meta.clear()
    untold = WindowSampler(recorded, SIZES, augment=True).batch(12, seeded())
    assert all(torch.equal(untold[name], x) for name, x in before.items())

    recorded.meta["positions_in_state"] = 2
    recorded.action[:] *= 100  # in another unit: 50 at most, and so after each map
    asked = WindowSampler(recorded, SIZES, augment=True).batch(12, seeded())["action"]
    assert 49 < asked[..., :3].abs().max() <= 50


def arm_recording(near=(0.0, np.pi, 0.0)):
    """Demonstrations as robot.py records them: a tool that points down, and turns at each step."""
    rng = np.random.default_rng(0)
    steps = rng.normal(size=(30, 6)) * 0.02
    poses = [np.array([0.1, 0.6, 0.2, 0.0, np.pi - 0.05, 0.0])]
    for step in steps[:-1]:
        before = Rotation.from_rotvec(poses[-1][3:])
        rotvec = (Rotation.from_rotvec(step[3:]) * before).as_rotvec()
        angle = np.linalg.norm(rotvec)
        forms = [rotvec, rotvec * (1 - 2 * np.pi / angle)]
        rotvec = min(forms, key=lambda form: np.linalg.norm(form - near))
        poses.append(np.append(poses[-1][:3] + step[:3], rotvec))
    grip = np.zeros((30, 1))
    return replace(
        recording((30,)),
        state=np.hstack([poses, grip]).astype(np.float32),
        action=np.hstack([steps, grip]).astype(np.float32),
        meta={"positions_in_state": 1, "rotation_near_rad": list(near)},
    )


def test_rotations_of_an_arm_turn_with_the_scene_and_actions_still_lead_to_the_next_pose():
    sizes = SimpleNamespace(**{**asdict(SIZES), "state_dim": 7, "action_dim": 7})
    sampler = WindowSampler(arm_recording(), sizes, augment=True)
    before = WindowSampler(arm_recording(), sizes).demonstration(0)
    after = sampler.batch(4, seeded())
    state, action = (
        after["demo_state"][0].double().numpy(),
        after["demo_action"][0].double().numpy(),
    )
    poses, turns = Rotation.from_rotvec(state[:, 3:6]), Rotation.from_rotvec(action[:-1, 3:6])
    assert (turns * poses[:-1] * poses[1:].inv()).magnitude().max() < 1e-5
    way = state[1:, :3] - state[:-1, :3]
    np.testing.assert_allclose(way, action[:-1, :3], atol=1e-5)

    # All by one turn, which is not small, and the vectors stay near the one that is named.
    old = Rotation.from_rotvec(before["demo_state"][0, :, 3:6].double())
    turned = poses * old.inv()
    assert (turned * turned[0].inv()).magnitude().max() < 1e-5 < 0.01 < turned[0].magnitude() < 0.3
    assert np.linalg.norm(state[:, 3:6] - np.array([0, np.pi, 0]), axis=1).max() < 1.0
    angles = np.linalg.norm(state[:, 3:6], axis=1)
    assert angles.min() < np.pi < angles.max()  # both forms are met


def test_without_a_stretch_rotations_turn_as_the_points_do(monkeypatch):
    monkeypatch.setattr(data, "STRETCH", 0.0)
    a, _ = data.sample_affine_maps(5, torch.zeros(1, 3), seeded())
    torch.testing.assert_close(data.nearest_rotations(a), a)
    rotvec, near = torch.randn(5, 7, 3, generator=seeded()), torch.zeros(3)
    turned = data.turn_rotation_vectors(rotvec, a, near)
    for maps, vectors, results in zip(a, rotvec, turned):
        expected = Rotation.from_matrix(maps.double()) * Rotation.from_rotvec(vectors.double())
        np.testing.assert_allclose(results, expected.as_rotvec(), atol=1e-5)
    still = data.turn_rotation_vectors(torch.zeros(1, 1, 3), torch.eye(3)[None], near)
    assert still.abs().max() == 0


def test_rotations_that_are_not_there_are_refused():
    sound = arm_recording()
    sound.check()
    for near in ([0, 1], [0, "1", 0], [0, float("inf"), 0], [10**400, 0, 0], 3.0):
        with pytest.raises(RecordingError, match="rotation_near_rad is"):
            replace(sound, meta={**sound.meta, "rotation_near_rad": near}).check()
    with pytest.raises(RecordingError, match="not have 7 and 4 numbers"):
        replace(sound, action=sound.action[:, :4]).check()
    replace(sound, action=sound.action[:, :4], meta={"rotation_near_rad": [0, 3, 0]}).check()


def test_one_map_moves_a_tasks_demonstration_and_windows_alike():
    recorded = recording((40, 30))
    recorded.meta["positions_in_state"] = 1
    place = torch.tensor([0.1, 0.6, 0.2])  # in the world's frame, as a goal is
    recorded.state[:, :3] = place
    for one_map, places in ((True, 1), (False, 13)):
        sampler = WindowSampler(recorded, SIZES, augment=True, one_map=one_map)
        batch = sampler.batch(12, seeded())
        moved = torch.cat([batch["state"][:, 0, :3], batch["demo_state"][:, 0, :3]])
        assert len(torch.unique(moved, dim=0)) == places and not torch.isclose(moved, place).all()


def test_colors_stay_as_they_are_where_scenes_are_moved():
    recorded = recording((40, 30))
    recorded.meta["positions_in_state"] = 1
    plain = WindowSampler(recorded, SIZES, augment=True)
    with_colors = WindowSampler(colored(recorded), COLORED, augment=True)
    still = WindowSampler(colored(recorded), COLORED).batch(12, seeded())
    expected, moved = plain.batch(12, seeded()), with_colors.batch(12, seeded())
    for name in ("points", "demo_points"):
        torch.testing.assert_close(moved[name][..., :3], expected[name])
        assert torch.equal(moved[name][..., 3:], still[name][..., 3:])
    assert torch.equal(with_colors.center, plain.center)


def test_affine_maps_keep_to_their_limits_about_the_middle(monkeypatch):
    middle = torch.tensor([[0.02, 0.65, 0.2]])
    a, b = data.sample_affine_maps(1000, middle, seeded())
    shift = (middle @ a.mT + b)[:, 0] - middle
    assert (shift.abs() <= torch.tensor(data.SHIFT) + 1e-6).all()
    assert (shift.abs().amax(0) > 0.9 * torch.tensor(data.SHIFT)).all()

    with monkeypatch.context() as patch:
        patch.setattr(data, "TURN", 0.0)
        a, _ = data.sample_affine_maps(1000, middle, seeded())
        stretch = a - torch.eye(3)  # (1000, 3, 3), only changes of length are left
        assert stretch.abs().max() <= data.STRETCH + 1e-6
        assert stretch.amax() > 0.9 * data.STRETCH and stretch.amin() < -0.9 * data.STRETCH

    monkeypatch.setattr(data, "STRETCH", 0.0)
    a, _ = data.sample_affine_maps(1000, middle, seeded())
    torch.testing.assert_close(a @ a.mT, torch.eye(3).expand_as(a))  # only turns are left
    assert (a[:, 2] == torch.tensor([0.0, 0.0, 1.0])).all()
    angles = torch.atan2(a[:, 1, 0], a[:, 0, 0])
    assert angles.abs().max() <= data.TURN + 1e-6
    assert angles.max() > 0.9 * data.TURN and angles.min() < -0.9 * data.TURN


def test_scenes_turn_about_the_middle_of_the_workspace_or_else_of_the_points():
    recorded = recording()
    cloud = recorded.points.astype(np.float32)
    middle = (cloud.min((0, 1)) + cloud.max((0, 1))) / 2
    np.testing.assert_allclose(WindowSampler(recorded, SIZES).center[0], middle, rtol=1e-6)
    recorded.meta["workspace"] = [[0, 0, 0], [1, 2, 3]]
    assert WindowSampler(recorded, SIZES).center.tolist() == [[0.5, 1.0, 1.5]]
