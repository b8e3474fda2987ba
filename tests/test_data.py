"""Tests of data.py against real Meta-World, analytic scenes, naive implementations and, where it runs, OpenGL."""

import json
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import gymnasium
import metaworld
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import data
from data import Demonstrations, InputError, MetaWorldPointCloudEnv, RayCastCamera, WindowSampler

ROOT = Path(data.__file__).resolve().parent


@pytest.fixture(scope="module")
def reach():
    return MetaWorldPointCloudEnv("reach")


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    return data.collect(["button-press-topdown"], folder, episodes=2, workers=1)["button-press-topdown"]


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


# --- Suites and names ------------------------------------------------------------------------------------------------


ML10 = "reach push pick-place door-open drawer-close button-press-topdown peg-insert-side window-open sweep basketball"
NOVEL = {
    "ml10": "drawer-open door-close shelf-place sweep-into lever-pull",
    "ml45": "bin-picking box-close hand-insert door-lock door-unlock",
}


def test_suites_are_metaworlds_published_splits():
    for suite, novel in NOVEL.items():
        base = set(ML10.split()) if suite == "ml10" else set(data.INSTRUCTIONS) - set(novel.split())
        ours = data.suite_tasks(suite)
        assert (set(ours[0]), set(ours[1])) == (base, set(novel.split()))
        assert (len(ours[0]), len(ours[1])) == (int(suite[2:]), 5)


def test_every_task_has_one_instruction_of_its_own():
    tasks = {name.removesuffix("-v3") for name in metaworld.env_dict.ALL_V3_ENVIRONMENTS}
    assert set(data.INSTRUCTIONS) == tasks and len(tasks) == 50
    assert len(set(data.INSTRUCTIONS.values())) == 50


@pytest.mark.parametrize("call", [lambda: data.check_task("shelf-plce"), lambda: data.suite_tasks("ml-10")])
def test_an_unknown_name_suggests_the_nearest(call):
    with pytest.raises(InputError, match=r"did you mean '(shelf-place|ml10)'"):
        call()


def test_demonstrations_and_evaluation_never_share_a_seed():
    tasks = list(data.INSTRUCTIONS)
    seeds = {data.demonstration_seed(task, seed, n) for task in tasks for seed in (0, 999) for n in range(2000)}
    assert len(seeds) == 50 * 2 * 2000 and max(seeds) < 10**8 <= data.evaluation_seed(0, 0)
    assert len({data.evaluation_seed(seed, episode) for seed in (0, 1, 2) for episode in range(50)}) == 150
    for seed in (-1, 1000):
        with pytest.raises(InputError, match="0 to 999"):
            data.demonstration_seed("reach", seed, 0)


# --- Camera ----------------------------------------------------------------------------------------------------------

SCENE = """
<mujoco><asset><material name="opaque" rgba="1 1 1 1"/></asset><worldbody>
  <camera name="down" pos="0 0 2" fovy="60"/>
  <geom type="plane" size="5 5 1"/>
  <body><geom name="ball" type="sphere" size="0.3" pos="0.4 0.3 0.5"/></body>
  <body><geom name="cube" type="box" size="0.2 0.2 0.2" pos="-0.5 -0.3 0.2"/></body>
  <body><geom name="hidden by the floor" type="sphere" size="0.1" pos="0.4 -0.4 -0.3"/></body>
  <geom type="box" size="0.2 0.2 0.2" pos="0 0 1.5" rgba="1 0 0 0" material="opaque"/>
  <geom type="box" size="0.2 0.2 0.2" pos="0 0 1.5" group="4"/>
  <site name="marker" type="sphere" size="0.1" pos="-0.4 0.4 0.6"/>
  <site type="sphere" size="0.3" pos="0 0 1" rgba="1 0 0 0"/>
</worldbody></mujoco>
"""


def test_depth_equals_an_analytic_scene_of_plane_balls_and_cube():
    model = mujoco.MjModel.from_xml_string(SCENE)
    physics = mujoco.MjData(model)
    mujoco.mj_forward(model, physics)
    pixels = 65
    camera = RayCastCamera(model, pixels, ((-1, -1, 0.01), (1, 1, 1)), "down", position=None)
    across = np.tan(np.pi / 6) * ((np.arange(pixels) + 0.5) / pixels * 2 - 1)
    x, y = np.meshgrid(across, -across)  # direction (x, y, -1) from (0, 0, 2): the parameter is the depth
    expected = np.full((pixels, pixels), 2.0)
    for center, radius in (((0.4, 0.3, 0.5), 0.3), ((-0.4, 0.4, 0.6), 0.1)):
        a, b = x**2 + y**2 + 1, x * center[0] + y * center[1] + 2 - center[2]
        c = center[0] ** 2 + center[1] ** 2 + (2 - center[2]) ** 2 - radius**2
        with np.errstate(invalid="ignore"):
            expected = np.fmin(expected, (b - np.sqrt(b**2 - a * c)) / a)
    inner = (np.abs(1.6 * x + 0.5) < 0.2) & (np.abs(1.6 * y + 0.3) < 0.2)
    sides = ((np.abs(2 * x + 0.5) < 0.32) & (np.abs(2 * y + 0.3) < 0.32)) & ~inner  # left to the test of the top
    depth = camera.depth(physics, pixels)
    expected[inner] = 1.6
    np.testing.assert_allclose(depth[~sides], expected[~sides], atol=1e-5)
    assert (depth < 1.5).sum() > 20 and inner.sum() > 20  # the balls and the cube were in view at all


def test_points_are_those_rays_that_end_on_objects_in_the_workspace():
    model = mujoco.MjModel.from_xml_string(SCENE)
    physics = mujoco.MjData(model)
    mujoco.mj_forward(model, physics)
    camera = RayCastCamera(model, 66, ((-1, -1, -1), (1, 1, 0.7)), "down", position=None)
    points = camera.points(physics)
    rays = camera.rays(66)
    distance, hit = camera.cast(physics, rays)
    every = (camera.origin + distance[:, None] * rays)[hit != 0]  # geom 0 is the floor: scenery
    every = every[(every[:, 2] <= 0.7)]
    np.testing.assert_allclose(points, every, atol=1e-6)
    on_ball = np.abs(np.linalg.norm(points - (0.4, 0.3, 0.5), axis=1) - 0.3) < 1e-4
    on_marker = np.abs(np.linalg.norm(points - (-0.4, 0.4, 0.6), axis=1) - 0.1) < 1e-4
    on_cube = np.abs(np.abs(points - (-0.5, -0.3, 0.2)).max(axis=1) - 0.2) < 1e-4
    assert (on_ball | on_marker | on_cube).all() and on_ball.any() and on_marker.any() and on_cube.any()


@pytest.mark.parametrize("task", ["reach", "hand-insert", "door-open"])
def test_casting_only_the_wanted_rays_loses_no_point(task):
    env = MetaWorldPointCloudEnv(task)
    env.begin(1)
    for _ in range(40):
        env.advance(env.expert_action())
    camera, physics = env.camera, env.simulator.data
    rays = camera.rays(camera.pixels)
    distance, hit = camera.cast(physics, rays)
    seen = (hit < -1) | ((hit >= 0) & ~camera.scenery[hit])
    every = camera.origin + distance[seen, None] * rays[seen]
    every = every[((every >= camera.low) & (every <= camera.high)).all(axis=1)]
    np.testing.assert_allclose(camera.points(physics), every, atol=1e-6)


def test_the_goal_marker_is_in_the_cloud(reach):
    seen = 0
    for seed in range(5):
        observation, _ = reach.reset(seed=seed)
        goal = reach.simulator._target_pos
        away = np.linalg.norm(observation["point_cloud"] - goal, axis=1)
        seen += (np.abs(away - 0.02) < 1e-4).sum() >= 2  # on a sphere of 2 cm around the goal
    assert seen == 5


RASTERIZE = """
import sys, numpy as np, mujoco, data
env = data.MetaWorldPointCloudEnv(sys.argv[1])
env.begin(0)
renderer = mujoco.Renderer(env.simulator.model, 84, 84)
renderer.enable_depth_rendering()
renderer.update_scene(env.simulator.data, data.CAMERA)
np.savez(sys.argv[2], rasterized=renderer.render(), cast=env.camera.depth(env.simulator.data, 84))
"""


@pytest.mark.parametrize("task", ["reach", "shelf-place", "window-open"])
def test_depth_equals_mujocos_rasterizer_where_opengl_works(task, tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "egl")
    command = [sys.executable, "-c", RASTERIZE, task, str(tmp_path / "depth.npz")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    if not (tmp_path / "depth.npz").exists():
        pytest.skip(f"NO OPENGL HERE, the rasterizer was not compared: {done.stderr.strip().splitlines()[-1]}")
    with np.load(tmp_path / "depth.npz") as depth:
        sky = np.isinf(depth["cast"])
        off = np.abs(depth["rasterized"] - depth["cast"])[~sky]
        assert (depth["rasterized"] > 50).sum() == pytest.approx(sky.sum(), rel=0.01)
    assert np.quantile(off, 0.99) < 1e-4  # metres; silhouettes may differ by a pixel


def test_the_picture_shows_the_red_marker_upright():
    env = gymnasium.make("DAMI/MetaWorld-v0", task="reach", render_mode="rgb_array")
    env.reset(seed=1)
    picture = env.render()
    assert picture.shape == (240, 240, 3) and picture.dtype == np.uint8
    assert picture[:20].mean() > picture[-20:].mean() + 50  # the sky is above the table
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


# --- Farthest point sampling -----------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("n", [1, 64, 300])
def test_farthest_points_cover_as_a_naive_implementation(reach, n):
    reach.reset(seed=0)
    clouds = [np.random.default_rng(0).normal(size=(700, 3)), reach.camera.points(reach.simulator.data)]
    for points in clouds:
        points = points.astype(np.float32)
        n = min(n, len(points) // 2)
        ours = data.farthest_point_sample(points, n)
        naive = naive_sample(points, n, ours[0])
        assert ours.shape == (n, 3)
        assert coverage(points, ours) == pytest.approx(coverage(points, naive), rel=0.01)


def test_the_first_points_of_a_sample_are_a_sample():
    points = np.random.default_rng(0).normal(size=(900, 3)).astype(np.float32)
    many = data.farthest_point_sample(points, 512)
    np.testing.assert_array_equal(many[:128], data.farthest_point_sample(points, 128))
    assert coverage(points, many[:128]) == pytest.approx(coverage(points, naive_sample(points, 128, many[0])), rel=0.01)


@pytest.mark.parametrize("count", [1, 2, 7, 8, 100])
def test_a_small_cloud_is_repeated_and_keeps_all_its_points(count):
    points = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    sample = data.farthest_point_sample(points, 250)
    assert sample.shape == (250, 3) and {tuple(p) for p in sample} == {tuple(p) for p in points}
    np.testing.assert_array_equal(sample[:count], sample[count : 2 * count])


def test_an_empty_cloud_is_an_error():
    with pytest.raises(ValueError, match="empty"):
        data.farthest_point_sample(np.empty((0, 3), np.float32), 8)


# --- Environment -----------------------------------------------------------------------------------------------------


def test_gymnasiums_checker_finds_no_fault():
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the checker only warns of most faults
        warnings.filterwarnings("ignore", message=".*(infinity|not within the expected|spec).*")
        check_env(gymnasium.make("DAMI/MetaWorld-v0", task="push").unwrapped, skip_render_check=True)
        check_env(MetaWorldPointCloudEnv("reach", render_mode="rgb_array"))


@pytest.mark.parametrize("task", list(data.INSTRUCTIONS))
def test_every_task_resets_to_a_finite_cloud_inside_the_workspace(task):
    env = MetaWorldPointCloudEnv(task, num_points=128)
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation) and info == {"success": False}
    cloud = observation["point_cloud"]
    assert np.isfinite(cloud).all() and len(np.unique(cloud, axis=0)) > 60
    assert (cloud >= np.float32(data.WORKSPACE[0])).all() and (cloud <= np.float32(data.WORKSPACE[1])).all()
    assert env.action_space.contains(env.expert_action())


@pytest.mark.parametrize("task", ["reach", "peg-insert-side", "push-back", "basketball"])
def test_a_seed_is_an_episode_whatever_came_before(task):
    used, fresh = MetaWorldPointCloudEnv(task), MetaWorldPointCloudEnv(task)
    used.reset(seed=3)
    for _ in range(60):
        used.advance(used.expert_action())
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    for seed in (7, 8):
        first, _ = used.reset(seed=seed)
        second, _ = fresh.reset(seed=seed)
        for _ in range(30):
            for key in first:
                np.testing.assert_array_equal(first[key], second[key])
            action = used.expert_action()
            first, second = used.step(action)[0], fresh.step(action)[0]
        if seed == 7:
            goal = used.simulator._target_pos.copy()
    assert np.linalg.norm(goal - used.simulator._target_pos) > 1e-3
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002 (left alone)


def test_advance_and_observe_make_a_step(reach):
    other = MetaWorldPointCloudEnv("reach")
    reach.reset(seed=5)
    other.reset(seed=5)
    for _ in range(10):
        action = reach.expert_action()
        observation, reward, terminated, truncated, info = reach.step(action)
        assert other.advance(action) == (reward, truncated, info) and not terminated
    for key, value in other.observe().items():
        np.testing.assert_array_equal(observation[key], value)


def test_an_episode_ends_at_200_steps_and_tells_success_each_step(reach):
    reach.begin(0)
    truncated, success = [], []
    for _ in range(200):
        _, end, info = reach.advance(reach.expert_action())
        truncated.append(end)
        success.append(info["success"])
    assert truncated == [False] * 199 + [True] and any(success) and not success[0]


@pytest.mark.parametrize("action", [[0, 0, 0], [0, 0, 0, np.nan]])
def test_an_action_that_is_not_four_finite_numbers_is_refused(reach, action):
    with pytest.raises(ValueError, match="four finite numbers"):
        reach.advance(action)


# --- Collection ------------------------------------------------------------------------------------------------------


def test_stored_actions_replayed_with_the_stored_seed_reach_success(collected):
    demonstrations = data.load_demonstrations(collected)
    env = MetaWorldPointCloudEnv(demonstrations.task)
    assert len(demonstrations) == 2
    for index, seed in enumerate(demonstrations.meta["episode_seeds"]):
        frames = demonstrations.episode(index)
        observation, _ = env.reset(seed=seed)
        np.testing.assert_array_equal(observation["agent_pos"], demonstrations.state[frames][0])
        np.testing.assert_array_equal(observation["point_cloud"].astype(np.float16), demonstrations.points[frames][0])
        succeeded = [env.advance(action)[2]["success"] for action in demonstrations.action[frames]]
        assert succeeded.index(True) == demonstrations.meta["success_frames"][index]


def test_failed_attempts_are_not_kept():
    env = MetaWorldPointCloudEnv("reach", num_points=8)
    env.expert.get_action = lambda raw: np.zeros(4)
    assert data.record_episode(env, 0) is None


def test_a_finished_file_is_kept_and_a_shorter_one_is_made_again(collected, monkeypatch):
    monkeypatch.setattr(data, "ProcessPoolExecutor", None)  # collecting anything would fail
    before = collected.stat().st_mtime_ns
    assert data.collect([collected.stem], collected.parent, episodes=2)[collected.stem] == collected
    assert data.collect([collected.stem], collected.parent, episodes=1)[collected.stem] == collected
    assert collected.stat().st_mtime_ns == before
    with pytest.raises(TypeError):
        data.collect([collected.stem], collected.parent, episodes=3)


def test_a_recording_made_otherwise_is_never_overwritten(collected, tmp_path):
    data.save_demonstrations(tmp_path / "reach.npz", recording())
    with pytest.raises(InputError, match="recorded otherwise"):
        data.collect(["reach"], tmp_path, episodes=1)
    with pytest.raises(InputError, match="recorded otherwise"):
        data.collect([collected.stem], collected.parent, episodes=1, seed=1)


# --- Files -----------------------------------------------------------------------------------------------------------


def test_a_file_gives_back_what_was_saved(tmp_path):
    saved = recording((50, 7, 120))
    data.save_demonstrations(tmp_path / "new" / "reach.npz", saved)
    loaded = data.load_demonstrations(tmp_path / "new" / "reach.npz")
    assert (loaded.task, loaded.instruction, loaded.meta) == (saved.task, saved.instruction, saved.meta)
    for field in ("points", "state", "action", "episode_ends"):
        np.testing.assert_array_equal(getattr(loaded, field), getattr(saved, field))
        assert getattr(loaded, field).dtype == getattr(saved, field).dtype
    assert len(loaded) == 3 and loaded.episode(1) == slice(50, 57)
    assert len(loaded.first(2)) == 2 and len(loaded.first(2).points) == 57
    with pytest.raises(InputError, match="4 demonstrations of reach were asked for, but there are 3"):
        loaded.first(4)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["reach.npz"]


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


def with_fields(path, **changes):
    """Write a file of demonstrations with some fields changed, past the checks of `save_demonstrations`."""
    good = recording((20, 10))
    arrays = {field: getattr(good, field) for field in data.FIELDS} | {"meta": json.dumps(good.meta)} | changes
    np.savez(path, **{field: value for field, value in arrays.items() if value is not None})


NAN = np.full((30, 16, 3), np.nan, np.float16)
BAD_FIELDS = {
    "lacks action": {"action": None},
    "points holds NaN": {"points": NAN},
    "state holds NaN": {"state": np.full((30, 9), np.inf, np.float32)},
    "lengths differ: 30 frames of points, 29 of state": {"state": np.zeros((29, 9), np.float32)},
    "episode_ends up to 31": {"episode_ends": np.array([20, 31])},
    "growing whole numbers": {"episode_ends": np.array([20, 20, 30])},
    "holds no episodes": {
        "points": NAN[:0],
        "state": np.zeros((0, 9), np.float32),
        "action": np.zeros((0, 4), np.float32),
        "episode_ends": np.array([], np.int64),
    },
    "points must be": {"points": np.zeros((30, 16, 2), np.float16)},
    "action must be 2-dimensional": {"action": np.zeros(30, np.float32)},
    "is damaged or no file of demonstrations: Object arrays": {"state": np.array([None, 1], dtype=object)},
    "is damaged or no file of demonstrations: Expecting": {"meta": "not json"},
}


@pytest.mark.parametrize("message", BAD_FIELDS)
def test_a_file_with_bad_contents_is_refused_in_one_line(tmp_path, message):
    with_fields(tmp_path / "reach.npz", **BAD_FIELDS[message])
    with pytest.raises(InputError, match=message) as caught:
        data.load_demonstrations(tmp_path / "reach.npz")
    assert "\n" not in str(caught.value) and "reach.npz" in str(caught.value)


def test_a_missing_truncated_or_foreign_file_is_refused_in_one_line(tmp_path):
    path = tmp_path / "reach.npz"
    with pytest.raises(InputError, match=r"missing: collect it with `python data.py --task reach`"):
        data.load_demonstrations(path)
    data.save_demonstrations(path, recording())
    whole = path.read_bytes()
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 255
    for content, message in (
        (whole[: len(whole) // 2], "truncated"),
        (b"", "truncated"),
        (b"task,points\n1,2\n", "no .npz file"),
        (bytes(damaged), "damaged"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=message) as caught:
            data.load_demonstrations(path)
        assert "\n" not in str(caught.value)


def test_bad_demonstrations_are_not_saved(tmp_path):
    with pytest.raises(InputError, match="NaN"):
        data.save_demonstrations(tmp_path / "reach.npz", replace(recording((20, 10)), points=NAN))
    assert not list(tmp_path.iterdir())


# --- Windows ---------------------------------------------------------------------------------------------------------


def test_200_frames_give_193_windows_and_short_episodes_at_least_one():
    assert len(WindowSampler(recording((200,)), num_points=16)) == 193
    assert len(WindowSampler(recording((200, 200)), num_points=16)) == 386
    assert len(WindowSampler(recording((1, 5)), num_points=16)) == 2
    assert len(WindowSampler(recording((16,)), num_points=16)) == 9
    assert len(WindowSampler(recording((50,)), horizon=4, n_obs_steps=1, n_action_steps=1, num_points=16)) == 47


def test_windows_equal_naive_slicing_of_the_padded_episodes():
    recorded = recording((40, 3, 25))
    sampler = WindowSampler(recorded, num_points=8)
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
    every, some = (WindowSampler(recorded, num_points=16, after_success=after) for after in (None, 5))
    last = (40 - 16 + 7, 30 - 16 + 7)  # where the last window of each whole episode begins
    assert len(every) == last[0] + 2 + last[1] + 2  # one begins a frame before the episode
    assert len(some) == 15 + 2 + last[1] + 2  # in the second episode success comes after the last window
    assert torch.equal(some.windows, torch.cat([every.windows[:17], every.windows[last[0] + 2 :]]))
    assert len(WindowSampler(recording((40, 30)), num_points=16, after_success=5)) == len(every)  # no success told
    assert len(WindowSampler(recorded.first(1), num_points=16, after_success=5)) == 17
    for wrong in ([10], [10, "28"], [10, -1], 10):
        with pytest.raises(InputError, match="success_frames must be"):
            replace(recorded, meta={"success_frames": wrong}).check("reach.npz")
    for wrong in (4, -1, "3", True):
        with pytest.raises(InputError, match="positions_in_state is"):
            replace(recorded, meta={"positions_in_state": wrong}).check("reach.npz")


def test_scenes_are_put_elsewhere_and_stay_consistent():
    recorded = recording((40, 30))
    rng = np.random.default_rng(0)
    recorded.action[:] = rng.uniform(-0.5, 0.5, recorded.action.shape)
    hand = np.cumsum(recorded.action[:, :3], axis=0) / 100 - recorded.action[:, :3] / 100  # action = 100 x displacement
    recorded.state[:, :6] = np.tile(hand, 2)
    recorded.points[:] = hand[:, None] + rng.uniform(-0.05, 0.05, (1, *recorded.points.shape[1:]))  # carried along
    recorded.meta["positions_in_state"] = 2
    plain, moved = (WindowSampler(recorded, num_points=16, augment=on) for on in (False, True))
    before, after = (s.batch(12, torch.Generator().manual_seed(0)) for s in (plain, moved))
    assert {name: x.shape for name, x in before.items()} == {name: x.shape for name, x in after.items()}
    for prefix in ("", "demo_"):
        points, state, action = (after[prefix + name] for name in ("points", "state", "action"))
        for part in (slice(0, 3), slice(3, 6)):
            torch.testing.assert_close(
                100 * state[:, :-1, part].diff(dim=1), action[:, : state.shape[1] - 2, :3], atol=1e-3, rtol=0
            )
        offsets = points - state[:, :, None, :3]  # the same in every frame of a scene, up to float16
        torch.testing.assert_close(offsets, offsets[:, :1].expand_as(offsets), atol=5e-3, rtol=0)
        assert torch.equal(state[..., 6:], before[prefix + "state"][..., 6:])
        assert torch.equal(action[..., 3:], before[prefix + "action"][..., 3:])
    shifts = (after["state"] - before["state"])[:, 0, :3]
    assert len(torch.unique(shifts, dim=0)) == 12 and 0.02 < shifts.abs().max() < 0.3  # each window its own
    recorded.meta.clear()
    untold = WindowSampler(recorded, num_points=16, augment=True).batch(12, torch.Generator().manual_seed(0))
    assert all(torch.equal(untold[name], x) for name, x in before.items())


def test_the_maps_of_scenes_keep_to_their_limits(monkeypatch):
    a, b = data.random_maps(1000, torch.Generator().manual_seed(0))
    middle = torch.tensor(data.WORKSPACE).mean(dim=0)
    shift = (middle[None] @ a.mT + b)[:, 0] - middle
    assert (shift.abs() <= torch.tensor(data.SHIFT) + 1e-6).all() and (shift.abs().amax(0) > 0.04).all()
    assert (torch.linalg.matrix_norm(a - torch.eye(3), ord=2) < 3 * data.STRETCH + 2 * data.TURN).all()
    monkeypatch.setattr(data, "STRETCH", 0.0)
    a, _ = data.random_maps(1000, torch.Generator().manual_seed(0))
    torch.testing.assert_close(a @ a.mT, torch.eye(3).expand_as(a))  # turns
    assert (a[:, 2] == torch.tensor([0.0, 0.0, 1.0])).all()
    angles = torch.atan2(a[:, 1, 0], a[:, 0, 0])
    assert angles.abs().max() <= data.TURN + 1e-6 and angles.max() > 0.9 * data.TURN and angles.min() < -0.9 * data.TURN


def test_sampling_is_float32_repeatable_and_without_repetition():
    sampler = WindowSampler(recording(), num_points=16)
    first, second = (sampler.sample(100, torch.Generator().manual_seed(0)) for _ in range(2))
    assert first["points"].shape == (100, 2, 16, 3) and first["action"].shape == (100, 16, 4)
    assert first["state"].shape == (100, 2, 9)
    assert all(value.dtype == torch.float32 and torch.equal(value, second[key]) for key, value in first.items())
    assert len(torch.unique(sampler.sample(len(sampler), torch.Generator())["action"], dim=0)) == len(sampler)
    assert len(sampler.sample(1000, torch.Generator())["action"]) == 1000
    assert sampler.points.dtype == torch.float16 and len(sampler.points) == 230  # held once, unexpanded


def test_a_demonstration_is_one_whole_episode_at_the_stride():
    recorded = recording((40, 25))
    sampler = WindowSampler(recorded, num_points=16, demo_stride=8)
    demonstration = sampler.demonstration(1)
    np.testing.assert_array_equal(demonstration["action"].numpy(), recorded.action[40:65:8])
    assert demonstration["points"].shape == (4, 16, 3) and demonstration["points"].dtype == torch.float32
    drawn = [len(sampler.demonstration(torch.Generator().manual_seed(seed))["state"]) for seed in range(20)]
    assert set(drawn) == {5, 4}


def test_sizes_that_do_not_fit_are_refused_with_both_numbers():
    with pytest.raises(InputError, match="16 points, but 32"):
        WindowSampler(recording(), num_points=32)
    with pytest.raises(InputError, match="16 executed actions do not fit a horizon of 16"):
        WindowSampler(recording(), n_action_steps=16, num_points=16)


# --- Command line ----------------------------------------------------------------------------------------------------


def test_show_draws_a_picture(tmp_path, capsys):
    data.save_demonstrations(tmp_path / "reach.npz", recording())
    data.main(["--show", str(tmp_path / "reach.npz")])
    assert (tmp_path / "reach.png").stat().st_size > 10_000 and "reach.png" in capsys.readouterr().out


def test_collecting_what_is_there_prints_a_table(collected, capsys):
    data.main(["--task", collected.stem, "--episodes", "2", "--data", str(collected.parent)])
    table = capsys.readouterr().out
    assert "expert" in table and "button-press-topdown" in table and "400" in table


@pytest.mark.parametrize(
    "argv, message",
    [
        (["--task", "raech"], "unknown task 'raech': did you mean 'reach'?"),
        (["--suite", "ml11"], "unknown suite 'ml11': did you mean 'ml10'?"),
        (["--show", "nothing.npz"], "nothing.npz is missing"),
        (["--task", "reach", "--episodes", "0"], "--episodes is 0"),
        (["--task", "reach", "--seed", "1000"], "use a seed from 0 to 999"),
    ],
)
def test_what_the_user_gets_wrong_ends_in_one_line_and_exit_code_2(argv, message, capsys):
    with pytest.raises(SystemExit) as end:
        data.command_line(lambda: data.main(argv))
    error = capsys.readouterr().err
    assert end.value.code == 2 and message in error and error.count("\n") == 1


def test_interrupting_ends_with_exit_code_130(capsys):
    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as end:
        data.command_line(interrupted)
    assert end.value.code == 130 and "interrupted" in capsys.readouterr().err
