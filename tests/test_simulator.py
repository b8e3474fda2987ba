"""Tests of simulator.py against real Meta-World, analytic scenes and, where it runs, OpenGL."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import metaworld
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from scipy.spatial import cKDTree

import scripts
import simulator
from data import load_demonstrations, save_demonstrations
from scripts import command_line, run_jobs
from simulator import MetaWorldPointCloudEnv, RayCastCamera, collect

ROOT = Path(simulator.__file__).resolve().parent


@pytest.fixture(scope="module")
def reach():
    return MetaWorldPointCloudEnv("reach")


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    task = "button-press-topdown"
    return collect([task], folder, episodes=2, workers=1)[task]


# ---- Suites, instructions, seeds -----------------------------------------------------------------

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
        others = set(simulator.INSTRUCTIONS) - set(novel.split())
        base = set(ML10.split()) if suite == "ml10" else others
        ours = simulator.suite_tasks(suite)
        assert (set(ours[0]), set(ours[1])) == (base, set(novel.split()))
        assert (len(ours[0]), len(ours[1])) == (int(suite[2:]), 5)


def test_every_task_has_one_instruction_of_its_own():
    tasks = {name.removesuffix("-v3") for name in metaworld.env_dict.ALL_V3_ENVIRONMENTS}
    assert set(simulator.INSTRUCTIONS) == tasks and len(tasks) == 50
    assert len(set(simulator.INSTRUCTIONS.values())) == 50


def test_demonstrations_and_evaluation_never_share_a_seed():
    seeds = {
        simulator.demonstration_seed(task, seed, attempt)
        for task in simulator.INSTRUCTIONS
        for seed in (0, 999)
        for attempt in range(2000)
    }
    assert len(seeds) == 50 * 2 * 2000 and max(seeds) < 10**8 <= simulator.evaluation_seed(0, 0)
    evaluated = {simulator.evaluation_seed(seed, e) for seed in (0, 1, 2) for e in range(50)}
    assert len(evaluated) == 150
    for seed in (-1, 1000):
        with pytest.raises(ValueError, match="0 to 999"):
            simulator.demonstration_seed("reach", seed, 0)


# ---- Camera --------------------------------------------------------------------------------------

SCENE = """
<mujoco><asset><material name="opaque" rgba="1 1 1 1"/></asset><worldbody>
  <camera name="down" pos="0 0 2" fovy="60"/>
  <camera name="turned" pos="0 0 2" mode="targetbody" target="b"/>
  <geom type="plane" size="5 5 1"/>
  <body name="b"><camera name="carried"/><geom type="sphere" size="0.3" pos="0.4 0.3 0.5"/></body>
  <body><geom name="cube" type="box" size="0.2 0.2 0.2" pos="-0.5 -0.3 0.2"/></body>
  <body><geom name="hidden by the floor" type="sphere" size="0.1" pos="0.4 -0.4 -0.3"/></body>
  <geom type="box" size="0.2 0.2 0.2" pos="0 0 1.5" rgba="1 0 0 0" material="opaque"/>
  <geom type="box" size="0.2 0.2 0.2" pos="0 0 1.5" group="4"/>
  <site name="marker" type="sphere" size="0.1" pos="-0.4 0.4 0.6"/>
  <site type="sphere" size="0.3" pos="0 0 1" rgba="1 0 0 0"/>
</worldbody></mujoco>
"""


def scene(pixels, box, camera="down"):
    """A camera that looks down on SCENE, and its state."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    physics = mujoco.MjData(model)
    mujoco.mj_forward(model, physics)
    return RayCastCamera(model, pixels, box, camera), physics


def test_depth_equals_an_analytic_scene_of_plane_balls_and_cube():
    pixels = 65
    camera, physics = scene(pixels, ((-1, -1, 0.01), (1, 1, 1)))
    across = np.tan(np.pi / 6) * ((np.arange(pixels) + 0.5) / pixels * 2 - 1)
    x, y = np.meshgrid(across, -across)  # direction (x, y, -1) from (0, 0, 2): depth is parameter
    expected = np.full((pixels, pixels), 2.0)
    for center, radius in (((0.4, 0.3, 0.5), 0.3), ((-0.4, 0.4, 0.6), 0.1)):
        a, b = x**2 + y**2 + 1, x * center[0] + y * center[1] + 2 - center[2]
        c = center[0] ** 2 + center[1] ** 2 + (2 - center[2]) ** 2 - radius**2
        with np.errstate(invalid="ignore"):
            expected = np.fmin(expected, (b - np.sqrt(b**2 - a * c)) / a)
    inner = (np.abs(1.6 * x + 0.5) < 0.2) & (np.abs(1.6 * y + 0.3) < 0.2)
    outer = (np.abs(2 * x + 0.5) < 0.32) & (np.abs(2 * y + 0.3) < 0.32)
    sides = outer & ~inner  # left to the test of the top
    depth = camera.depth(physics)
    expected[inner] = 1.6
    np.testing.assert_allclose(depth[~sides], expected[~sides], atol=1e-5)
    assert (depth < 1.5).sum() > 20 and inner.sum() > 20  # balls and cube were in view at all


def test_points_lie_on_what_the_camera_sees_of_objects_and_small_ones_get_more():
    camera, physics = scene(40, ((-1, -1, -1), (1, 1, 0.7)))
    points = camera.points(physics)
    on_ball = np.abs(np.linalg.norm(points - (0.4, 0.3, 0.5), axis=1) - 0.3) < 1e-4
    on_marker = np.abs(np.linalg.norm(points - (-0.4, 0.4, 0.6), axis=1) - 0.1) < 1e-4
    on_cube = np.abs(np.abs(points - (-0.5, -0.3, 0.2)).max(axis=1) - 0.2) < 1e-4
    assert (on_ball | on_marker | on_cube).all()
    finer, few = 80, []
    for pixels in (40, finer):
        rays = camera.rays(pixels)
        distance, hit = camera.cast(physics, rays)
        low = camera.origin[2] + distance * rays[:, 2] <= 0.7
        few.append((hit[low] < -1).sum())
        counted = [(hit[low] == geom).sum() for geom in (3, 4)]  # ball and cube
        if pixels == 40:
            assert [on_ball.sum(), on_cube.sum()] == counted and min(counted) >= simulator.FEW_RAYS
    assert few[0] < simulator.FEW_RAYS and on_marker.sum() == few[1] > 3 * few[0]


def test_a_marker_above_the_workspace_hides_nothing_in_it():
    camera, physics = scene(66, ((-1, -1, -1), (1, 1, 0.7)))
    before = camera.points(physics)
    on_marker = np.abs(np.linalg.norm(before - (-0.4, 0.4, 0.6), axis=1) - 0.1) < 1e-4
    physics.site("marker").xpos[:] = (-0.25, -0.15, 1.2)  # halfway from the camera to the cube
    np.testing.assert_array_equal(camera.points(physics), before[~on_marker])


def test_a_camera_that_could_only_be_silent_is_refused():
    for name in ("carried", "turned"):
        with pytest.raises(ValueError, match=f"'{name}' moves with a body"):
            scene(8, ((-1, -1, -1), (1, 1, 1)), name)
    with pytest.raises(ValueError, match="'down' does not see the workspace"):
        scene(8, ((-1, -1, 3), (1, 1, 4)))


def test_the_camera_sees_a_model_of_another_package():
    path = Path(gymnasium.__file__).parent / "envs/mujoco/assets/pusher_v5.xml"
    spec = mujoco.MjSpec.from_file(str(path))
    spec.worldbody.add_camera(name="above", pos=(0.45, -0.05, 1.5))  # it looks down
    model = spec.compile()
    physics = mujoco.MjData(model)
    mujoco.mj_forward(model, physics)
    box = ((-0.3, -0.8, -0.4), (1.2, 0.7, 0.5))
    camera = RayCastCamera(model, 64, box, "above")
    points = camera.points(physics)
    middle, radius = physics.body("object").xpos, model.geom(model.body("object").geomadr[0]).size
    on_object = np.linalg.norm(points[:, :2] - middle[:2], axis=1) < radius[0] + 1e-6
    assert 20 < on_object.sum() < len(points)  # the puck, and the arm

    arm = [model.body(i).name for i in range(model.nbody) if model.body(i).name.startswith("r_")]
    camera = RayCastCamera(model, 64, box, "above", arm=arm)
    things, of_arm = camera.points(physics), camera.arm_points(physics)
    np.testing.assert_allclose(things, points[np.isin(points, things).all(axis=1)])
    assert len(of_arm) > 50 and not np.isin(of_arm, things).all(axis=1).any()


@pytest.mark.parametrize("task", ["hand-insert", "door-open"])
def test_points_are_what_rays_meet_first_and_nothing_is_left_out(task):
    env = MetaWorldPointCloudEnv(task)
    env.begin(1)
    for _ in range(40):
        env.advance(env.expert_action())
    model, physics = env.simulator.model, env.simulator.data
    box, place = simulator.WORKSPACE, simulator.CAMERA_POSITION
    camera = RayCastCamera(model, 84, box, simulator.CAMERA, place)  # the arm as it is
    points = camera.points(physics)
    away = np.linalg.norm(points - camera.origin, axis=1)
    distance, hit = camera.cast(physics, (points - camera.origin) / away[:, None])
    np.testing.assert_allclose(distance, away, atol=1e-5)  # nothing is before them
    assert ((hit < -1) | ~camera.scenery[hit]).all()

    rays = camera.rays(84)
    distance, hit = camera.cast(physics, rays)
    seen = (hit < -1) | ((hit >= 0) & ~camera.scenery[hit])
    every = camera.origin + distance[seen, None] * rays[seen]
    every = every[((every >= camera.low) & (every <= camera.high)).all(axis=1)]
    apart = cKDTree(points).query(every)[0]
    assert np.median(apart) < 1e-6 and np.quantile(apart, 0.99) < 0.01  # a pixel is a centimetre


def test_ellipsoids_hide_what_the_arm_hides(reach):
    """Their outline differs: 0.86 of what both cover is common, where the depth is 1 cm off."""
    camera, common, either, apart = reach.camera, 0, 0, []
    links = np.isin(np.arange(camera.model.ngeom), camera.arm)
    for seed in range(4):
        reach.begin(seed)
        for _ in range(30 * seed):
            reach.advance(reach.expert_action())
        rays, physics = camera.workspace_rays, reach.simulator.data
        exact, _ = camera.cast(physics, rays, geoms=links, sites=())
        rough = camera.cast_at_arm(physics, rays)
        both = np.isfinite(exact) & np.isfinite(rough)
        common, either = (
            common + both.sum(),
            either + (np.isfinite(exact) | np.isfinite(rough)).sum(),
        )
        apart.extend(np.abs(exact[both] - rough[both]))
    assert common / either > 0.82 and np.median(apart) < 0.013


def test_a_camera_inside_an_ellipsoid_looks_through_it():
    rays, half = np.eye(3), np.array([0.1, 0.2, 0.3])
    for center in ((0.05, 0, 0), (1.0, 0, 0)):
        met = simulator.meet_ellipsoid(np.zeros(3), rays, np.array(center), np.eye(3), half)
        np.testing.assert_allclose(met, [0.9 if center[0] == 1 else np.inf, np.inf, np.inf])


def test_the_arm_fills_up_a_cloud_and_fewer_points_are_the_first_of_more():
    clouds, envs = [], [MetaWorldPointCloudEnv("sweep", n) for n in (128, 512)]
    for env in envs:
        env.begin(simulator.demonstration_seed("sweep", 0, 0))
        for _ in range(73):  # here the arm hides everything
            env.advance(env.expert_action())
        clouds.append(env.cloud())
    np.testing.assert_array_equal(clouds[0], clouds[1][:128])
    assert len(np.unique(clouds[0], axis=0)) == 128  # no point twice
    things = envs[0].camera.points(envs[0].simulator.data)
    of_arm = ~np.isin(clouds[0], things).all(axis=1)
    assert of_arm.sum() == 128 - len(things) > 100


def test_what_stands_still_is_met_once_an_episode():
    env = MetaWorldPointCloudEnv("shelf-place")
    met = []
    for seed in (0, 1):  # each puts the shelf elsewhere
        env.begin(seed)
        for _ in range(3):
            env.cloud()
            met.append(env.camera.met_still)
            env.advance(env.expert_action())
    assert met[0] is met[1] is met[2] is not met[3] is met[4] is met[5]


def test_the_goal_marker_is_in_the_cloud(reach):
    for seed in range(5):
        observation, _ = reach.reset(seed=seed)
        away = np.linalg.norm(observation["point_cloud"] - reach.simulator._target_pos, axis=1)
        assert (np.abs(away - 0.02) < 1e-4).sum() >= 2  # on a sphere of 2 cm around the goal


RASTERIZE = """
import sys, numpy as np, mujoco, simulator
images = []
for task in ("reach", "shelf-place", "window-open"):
    env = simulator.MetaWorldPointCloudEnv(task)
    env.begin(0)
    renderer = mujoco.Renderer(env.simulator.model, 84, 84)
    renderer.enable_depth_rendering()
    renderer.update_scene(env.simulator.data, simulator.CAMERA)
    images.append((renderer.render(), env.camera.depth(env.simulator.data)))
np.save(sys.argv[1], images)
"""


def test_depth_equals_mujocos_rasterizer_where_opengl_works(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "egl")  # it is chosen at import: in a process of its own
    command = [sys.executable, "-c", RASTERIZE, str(tmp_path / "depth.npy")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    if not (tmp_path / "depth.npy").exists():
        reason = done.stderr.strip().splitlines()[-1]
        pytest.skip(f"NO OPENGL HERE, the rasterizer was not compared: {reason}")
    for rasterized, cast in np.load(tmp_path / "depth.npy"):
        sky = np.isinf(cast)
        assert (rasterized > 50).sum() == pytest.approx(sky.sum(), rel=0.01)
        off = np.abs(rasterized - cast)[~sky]
        assert np.quantile(off, 0.99) < 1e-4  # metres; silhouettes may differ by a pixel


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


@pytest.mark.parametrize("task", list(simulator.INSTRUCTIONS))
def test_every_task_resets_to_a_finite_cloud_inside_the_workspace(task):
    env = MetaWorldPointCloudEnv(task, num_points=128)
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation) and info == {"success": False}
    cloud = observation["point_cloud"]
    assert np.isfinite(cloud).all() and len(np.unique(cloud, axis=0)) > 60
    low, high = np.float32(simulator.WORKSPACE)
    assert (cloud >= low).all() and (cloud <= high).all()
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


# ---- Worker processes ----------------------------------------------------------------------------


def test_results_come_in_the_order_of_the_jobs_from_processes_that_were_set_up(tmp_path):
    names = ["c", "a", "b"]
    setup = (os.chdir, tmp_path)
    found = run_jobs(os.path.abspath, [(name,) for name in names], 2, 3, "naming", setup)
    assert found == [str(tmp_path / name) for name in names]


@pytest.mark.parametrize(
    "job, jobs, setup, error, message",
    [
        (os._exit, [(1,)], None, ValueError, "killed, perhaps for memory: try fewer --workers"),
        (time.sleep, [(60,), ("long",)], None, TypeError, "str"),
        (time.sleep, [(0,)], (os.chdir, "no such folder"), FileNotFoundError, "no such folder"),
    ],
)
def test_a_fault_in_one_process_ends_all(job, jobs, setup, error, message, capfd):
    start = time.monotonic()
    with pytest.raises(error, match=message):
        run_jobs(job, jobs, 2, len(jobs), "failing", setup)
    assert time.monotonic() - start < 30 and not multiprocessing.active_children()
    assert "Traceback" not in capfd.readouterr().err
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler  # Ctrl-C works again


SLEEPERS = """
import os, signal, sys, threading, time
import scripts
kill, target = (os.kill, os.getpid()) if sys.argv[1] == "SIGKILL" else (os.killpg, 0)
threading.Timer(0.3, kill, (target, signal.Signals[sys.argv[1]])).start()
sleepers = [(60,), (60,)]
scripts.command_line(lambda: scripts.run_jobs(time.sleep, sleepers, 2, 2, "sleeping"))
"""


@pytest.mark.parametrize(
    "name, code", [("SIGINT", 130), ("SIGHUP", 130), ("SIGKILL", -signal.SIGKILL)]
)
def test_ctrl_c_or_a_kill_while_workers_import_leaves_no_process_and_no_traceback(name, code):
    command = [sys.executable, "-c", SLEEPERS, name]
    process = subprocess.Popen(
        command, cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        _, error = process.communicate(timeout=30)  # until the last process closes its stderr
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == code and "Traceback" not in error
    assert ("interrupted" in error) == (code == 130)


# ---- Collecting ----------------------------------------------------------------------------------


def test_stored_actions_replayed_with_the_stored_seed_reach_success(collected):
    recorded = load_demonstrations(collected)
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


def test_failed_and_interrupted_attempts_are_not_kept(reach, monkeypatch):
    stop = threading.Event()
    monkeypatch.setattr(simulator, "worker", SimpleNamespace(stop=stop))
    stop.set()
    assert simulator.record_episode(reach, 0) is None
    stop.clear()
    monkeypatch.setattr(reach.expert, "get_action", lambda raw: np.zeros(4))
    assert simulator.record_episode(reach, 0) is None


def test_a_finished_file_is_kept_and_a_shorter_one_is_made_again(collected, monkeypatch):
    monkeypatch.setattr(scripts, "ProcessPoolExecutor", None)  # collecting anything would fail
    before = collected.stat().st_mtime_ns
    for episodes in (2, 1):
        kept = collect([collected.stem], collected.parent, episodes)
        assert kept == {collected.stem: collected}
    assert collected.stat().st_mtime_ns == before
    with pytest.raises(TypeError):
        collect([collected.stem], collected.parent, episodes=3)


def test_a_recording_made_otherwise_is_never_overwritten(collected, tmp_path):
    recorded = load_demonstrations(collected)
    other_camera = replace(recorded, meta=recorded.meta | {"camera": ["topview", None, 84]})
    path = tmp_path / collected.name
    other_task = replace(recorded, task="reach")
    cases = [(other_camera, 0, "camera"), (other_task, 0, "task"), (recorded, 1, "seed")]
    for other, seed, what in cases:
        save_demonstrations(path, other)
        before = path.read_bytes()
        with pytest.raises(ValueError, match=f"recorded with another {what}: move it"):
            collect([collected.stem], tmp_path, 3, seed)
        assert path.read_bytes() == before


# ---- Command line --------------------------------------------------------------------------------


def test_collecting_what_is_there_prints_a_table(collected, capsys):
    simulator.main(["--task", collected.stem, "--episodes", "2", "--data", str(collected.parent)])
    table = capsys.readouterr().out
    assert "expert" in table and "button-press-topdown" in table and "400" in table


@pytest.mark.parametrize(
    "argv, message",
    [
        (["--task", "raech"], "unknown task 'raech': did you mean 'reach'?"),
        (["--suite", "ml11"], "unknown suite 'ml11': did you mean 'ml10'?"),
        (["--task", "reach", "--episodes", "0"], "--episodes is 0: use at least 1"),
        (["--task", "reach", "--workers", "0"], "--workers is 0: use at least 1"),
        (["--task", "reach", "--seed", "1000"], "use a seed from 0 to 999"),
    ],
)
def test_what_the_user_gets_wrong_ends_in_one_line_and_exit_code_2(argv, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        command_line(lambda: simulator.main([*argv, "--data", str(tmp_path)]))
    error = capsys.readouterr().err
    assert end.value.code == 2 and message in error and error.count("\n") == 1


def test_the_oracle_tells_a_worker_where_object_and_goal_are(tmp_path):
    argv = f"positions simulator.py --task push --episodes 1 --workers 1 --data {tmp_path}"
    subprocess.run([sys.executable, "-m", "tests.oracle", *argv.split()], check=True, cwd=ROOT)
    told = load_demonstrations(tmp_path / "push.npz")
    env = MetaWorldPointCloudEnv("push")
    env.begin(told.meta["episode_seeds"][0])
    positions = np.concatenate([env.raw[4:7], env.raw[-3:]])
    assert told.state.shape == (200, 15) and told.meta["positions_in_state"] == 5
    np.testing.assert_allclose(told.state[0, 9:], positions, atol=1e-6)
    moved = np.abs(told.state[-1, 9:] - told.state[0, 9:])
    assert moved[:3].max() > 0.05 and moved[3:].max() == 0  # the puck, not its goal
    with pytest.raises(ValueError, match="recorded with another positions_in_state"):
        collect(["push"], tmp_path, episodes=1)
