"""Tests of metaworld_env.py against Meta-World itself."""

import pickle
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import metaworld
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import metaworld_env
from common import UserError
from data import Demonstrations, load_demonstrations, save_demonstrations
from metaworld_env import MetaWorld, MetaWorldPointCloudEnv
from simulator import SIMULATORS, OutOfSightError, collect, demonstration_seed

ROOT = Path(metaworld_env.__file__).resolve().parent


@pytest.fixture(scope="module")
def reach():
    return MetaWorldPointCloudEnv("reach")


# ---- Suites and instructions ---------------------------------------------------------------------

ML10 = (
    "reach push pick-place door-open drawer-close button-press-topdown peg-insert-side window-open "
    "sweep basketball"
)
NOVEL = {
    "ml10": "drawer-open door-close shelf-place sweep-into lever-pull",
    "ml45": "bin-picking box-close hand-insert door-lock door-unlock",
}


def test_suites_are_metaworlds_published_splits():
    for suite, novel in NOVEL.items():
        others = set(metaworld_env.INSTRUCTIONS) - set(novel.split())
        base = set(ML10.split()) if suite == "ml10" else others
        base_tasks, novel_tasks = MetaWorld().tasks(suite)
        assert (set(base_tasks), set(novel_tasks)) == (base, set(novel.split()))
        assert (len(base_tasks), len(novel_tasks)) == (int(suite[2:]), 5)
    assert set(metaworld_env.SUITES) == {"ml10", "ml45"} <= set(SIMULATORS)


def test_every_task_has_one_instruction_of_its_own():
    tasks = {name.removesuffix("-v3") for name in metaworld.env_dict.ALL_V3_ENVIRONMENTS}
    assert set(metaworld_env.INSTRUCTIONS) == tasks and len(tasks) == 50
    assert len(set(metaworld_env.INSTRUCTIONS.values())) == 50


# ---- Clouds and pictures -------------------------------------------------------------------------


def test_the_arm_is_left_out_of_clouds_and_fewer_points_are_the_first_of_more():
    envs = [MetaWorldPointCloudEnv("sweep", n) for n in (128, 512)]
    arm_in_sight = []
    for env in envs:
        env.begin(demonstration_seed(MetaWorld(), "sweep", seed=0, attempt=0))
    for _ in range(80):
        clouds = [env.cloud() for env in envs]
        np.testing.assert_array_equal(clouds[0], clouds[1][:128])
        points, ids = envs[0].camera.points(envs[0].sawyer_env.data, segmentation=True)
        of_arm = np.isin(ids, envs[0].arm_geoms)
        expected = points if of_arm.all() else points[~of_arm]
        assert {*map(tuple, clouds[1])} <= {*map(tuple, expected)}
        arm_in_sight.append(of_arm.any())
        for env in envs:
            env.advance(env.expert_action())
    assert any(arm_in_sight)


def test_an_empty_cloud_is_refused_and_one_of_the_arm_alone_is_not(reach, monkeypatch):
    reach.begin(0)
    points, ids = reach.camera.points(reach.sawyer_env.data, segmentation=True)
    of_arm = np.isin(ids, reach.arm_geoms)
    monkeypatch.setattr(reach.camera, "points", lambda *_, **__: (points[of_arm], ids[of_arm]))
    assert len(np.unique(reach.observe()["point_cloud"], axis=0)) > 100
    monkeypatch.setattr(reach.camera, "points", lambda *_, **__: (points[:0], ids[:0]))
    with pytest.raises(OutOfSightError, match="reach: nothing was seen"):
        reach.observe()


@pytest.mark.parametrize("task", ["reach", "reach-wall"])
def test_the_expert_of_reach_brings_the_fingertips_to_the_goal(task):
    env = MetaWorldPointCloudEnv(task)
    for seed in range(3):
        env.begin(seed)
        for _ in range(80):
            _, _, info = env.advance(env.expert_action())
        away = np.linalg.norm(env.sawyer_env.tcp_center - env.sawyer_env._target_pos)
        assert info["success"] and away < 0.02  # Meta-World's own ends 4.5 cm away, and 5 is lost


@pytest.mark.parametrize("task", ["pick-place", "pick-place-wall"])
def test_the_expert_of_pick_place_brings_the_puck_to_the_goal(task):
    env = MetaWorldPointCloudEnv(task)
    for seed in range(3):
        env.begin(seed)
        for _ in range(env.episode_steps):
            _, _, info = env.advance(env.expert_action())
        puck = env.expert_observation[4:7]
        away = np.linalg.norm(puck - env.sawyer_env._target_pos)
        assert info["success"] and away < 0.035  # half of the 7 cm that count as success


def test_the_expert_of_door_open_rests_where_metaworlds_own_lets_the_door_go():
    successes = {}  # rest_after -> those of each step
    for rest_after in (metaworld_env.REST_AFTER, None):
        env = MetaWorldPointCloudEnv("door-open")
        env.rest_after = rest_after
        env.begin(0)
        taken, hands, successes[rest_after] = [], [], []
        for _ in range(env.episode_steps):
            hands.append(env.hand())
            taken.append(env.expert_action())
            successes[rest_after].append(env.advance(taken[-1])[2]["success"])
        if rest_after is not None:
            succeeds = successes[rest_after].index(True)
            rests = succeeds + rest_after
            actions = np.array(taken)
            assert all(successes[rest_after][succeeds:])
            assert np.abs(actions[rests - 1, :3]).max() > 0.1
            back = metaworld_env.REST_GAIN * (hands[rests] - np.array(hands[rests:]))
            np.testing.assert_allclose(actions[rests:, :3], back, atol=1e-6)
            assert np.abs(back[-50:]).max() < 0.1  # the hand is within a centimetre
            np.testing.assert_array_equal(actions[rests:, 3], actions[rests - 1, 3])
            env.begin(0)
            np.testing.assert_array_equal(env.expert_action(), taken[0])  # it rests no longer
    assert any(successes[None]) and not successes[None][-1]


def test_an_expert_at_rest_stays_where_it_is_and_an_action_of_zero_would_not():
    moved = {}  # how far from where it began to rest, in metres
    for resting in (True, False):
        env = MetaWorldPointCloudEnv("push")
        env.begin(0)
        while env.resting_place is None:
            env.advance(env.expert_action())
        place = env.hand()
        for _ in range(100):
            still = np.array([0, 0, 0, env.gripper])
            env.advance(env.expert_action() if resting else still)
        moved[resting] = np.linalg.norm(env.hand() - place)
    assert moved[True] < 0.002 and moved[False] > 0.01


def test_the_goal_marker_is_in_the_cloud(reach):
    for seed in range(5):
        observation, _ = reach.reset(seed=seed)
        away = np.linalg.norm(observation["point_cloud"] - reach.sawyer_env._target_pos, axis=1)
        assert (np.abs(away - 0.02) < 1e-4).sum() >= 2  # on a sphere of 2 cm around the goal


def test_the_picture_shows_the_red_marker_upright():
    env = gymnasium.make("DAMI/MetaWorld-v0", task="reach", render_mode="rgb_array")
    env.reset(seed=1)
    picture = env.render()
    assert picture.shape == (240, 240, 3) and picture.dtype == np.uint8
    assert picture[:20].mean() > picture[-20:].mean() + 50  # the sky is above the table
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


# ---- Environment ---------------------------------------------------------------------------------


def test_gymnasiums_checker_finds_no_fault():
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the checker only warns of most faults
        warnings.filterwarnings("ignore", message=".*(infinity|not within the expected|spec).*")
        made = gymnasium.make("DAMI/MetaWorld-v0", task="push").unwrapped
        check_env(made, skip_render_check=True)
        check_env(MetaWorldPointCloudEnv("reach", render_mode="rgb_array"))


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
            goal = used.sawyer_env._target_pos.copy()
    assert np.linalg.norm(goal - used.sawyer_env._target_pos) > 1e-3
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


def test_touching_is_what_metaworlds_own_loops_say():
    env = MetaWorldPointCloudEnv("pick-place")
    env.begin(0)
    sawyer_env = env.sawyer_env
    puck = sawyer_env._get_id_main_object()
    ours, metaworlds = [], []
    for _ in range(80):
        env.advance(env.expert_action())
        ours.append(sawyer_env.touching_object(puck))
        metaworlds.append(type(sawyer_env).touching_object(sawyer_env, puck))
    assert ours == metaworlds and 20 < sum(ours) < 60  # it grasps the puck on the way


def test_an_episode_ends_at_200_steps_and_tells_success_each_step(reach):
    reach.begin(0)
    truncated, success = [], []
    for _ in range(200):
        _, end, info = reach.advance(reach.expert_action())
        truncated.append(end)
        success.append(info["success"])
    assert truncated == [False] * 199 + [True] and any(success) and not success[0]


def test_a_simulator_of_shorter_episodes_makes_them():
    simulator = pickle.loads(pickle.dumps(MetaWorld(episode_steps=3)))  # as workers get it
    env = simulator.make("reach", num_points=16)
    env.begin(0)
    assert [env.advance(env.expert_action())[1] for _ in range(3)] == [False, False, True]
    assert env.observe()["point_cloud"].shape == (16, 3)


def test_an_unknown_task_suggests_the_nearest_right_one():
    with pytest.raises(UserError, match="did you mean 'reach'"):
        MetaWorldPointCloudEnv("raech")


@pytest.mark.parametrize("action", [[0, 0, 0], [0, 0, 0, np.nan]])
def test_an_action_that_is_not_four_finite_numbers_is_refused(reach, action):
    with pytest.raises(ValueError, match="four finite numbers"):
        reach.advance(action)


def test_a_state_is_the_hand_the_right_and_the_left_finger(reach):
    reach.begin(0)
    data = reach.sawyer_env.data
    sites = [data.site(f"{side}EndEffector").xpos for side in ("right", "left")]
    expected = np.concatenate([data.body("hand").xpos, *sites])
    np.testing.assert_allclose(reach.observe()["agent_pos"], expected, atol=1e-6)
    assert np.abs(sites[0] - sites[1]).max() > 0.01  # so that it shows which is which


# ---- Recordings ----------------------------------------------------------------------------------


def test_stored_actions_replayed_with_the_stored_seed_reach_success(tmp_path):
    paths = collect(MetaWorld(), ["button-press-topdown"], tmp_path, episodes=2, workers=1)
    recorded = load_demonstrations(paths["button-press-topdown"])
    assert recorded.meta["simulator"] == "meta-world"
    env = MetaWorldPointCloudEnv(recorded.task)
    assert len(recorded) == 2
    for index, seed in enumerate(recorded.meta["episode_seeds"]):
        frames = recorded.episode(index)
        observation, _ = env.reset(seed=seed)
        cloud = observation["point_cloud"].astype(np.float16)
        np.testing.assert_array_equal(observation["agent_pos"], recorded.state[frames][0])
        np.testing.assert_array_equal(cloud, recorded.points[frames][0])
        succeeded = [env.advance(action)[2]["success"] for action in recorded.action[frames]]
        assert succeeded.index(True) == recorded.meta["success_frames"][index]


def test_recordings_of_the_camera_before_are_refused_in_one_line(tmp_path):
    shape = (1, metaworld_env.NUM_POINTS, 3)
    recipe = {
        **metaworld_env.RECIPE,
        "camera": ["corner2", [0.6, 0.295, 0.8], 84, "twice where something small is"],
        "arm": ["ellipsoids", "after at most", 384],
        "seed": 0,
    }
    recorded = Demonstrations(
        task="reach",
        instruction=metaworld_env.INSTRUCTIONS["reach"],
        points=np.ones(shape, np.float16),
        state=np.zeros((1, 9), np.float32),
        action=np.zeros((1, 4), np.float32),
        episode_ends=np.array([1]),
        meta=recipe,
    )
    save_demonstrations(tmp_path / "reach.npz", recorded)
    with pytest.raises(
        UserError, match=r"reach\.npz was recorded with another camera, arm: move it"
    ):
        collect(MetaWorld(), ["reach"], tmp_path, episodes=1)


def test_the_oracle_tells_a_worker_where_object_and_goal_are(tmp_path):
    argv = f"positions simulator.py --task push --episodes 1 --workers 1 --data {tmp_path}"
    subprocess.run([sys.executable, "-m", "tests.oracle", *argv.split()], check=True, cwd=ROOT)
    recorded = load_demonstrations(tmp_path / "push.npz")
    env = MetaWorldPointCloudEnv("push")
    env.begin(recorded.meta["episode_seeds"][0])
    positions = np.concatenate([env.expert_observation[4:7], env.expert_observation[-3:]])
    assert recorded.state.shape == (200, 15) and recorded.meta["positions_in_state"] == 5
    np.testing.assert_allclose(recorded.state[0, 9:], positions, atol=1e-6)
    moved = np.abs(recorded.state[-1, 9:] - recorded.state[0, 9:])
    assert moved[:3].max() > 0.05 and moved[3:].max() == 0  # the puck, not its goal
    with pytest.raises(UserError, match="recorded with another positions_in_state"):
        collect(MetaWorld(), ["push"], tmp_path, episodes=1)


def test_an_episode_may_be_longer_than_those_of_meta_world():
    env = MetaWorldPointCloudEnv("reach", num_points=64, episode_steps=502)  # there 500
    env.begin(0)
    truncated = [env.advance(np.zeros(4))[1] for _ in range(502)]
    assert truncated == [False] * 501 + [True]
