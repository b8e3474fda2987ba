"""Pairs of tasks that begin alike, and skills whose actions are turned by an unknown angle."""

import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import evaluate
import finetune
import train
import unnamed_tasks
from hidden_goals import CAMERA_PIXELS
from simulator import demonstration_seed, evaluation_seed, record_episode, simulator_of
from tests.runs import UNNAMED_SUITES, plan_of
from unnamed_tasks import ANGLES, SCENES, Conventions, Pairs, angle_of, bound_norm, turn

PAIRS, CONVENTIONS = Pairs(), Conventions()
# How far a joint has moved at least when a task is done, in radians or metres
LEAST_TRAVEL = {
    "faucet-open-hidden": 1.0,
    "faucet-close-hidden": -1.0,
    "drawer-open-hidden": -0.07,
    "drawer-close-hidden": 0.04,
}


@pytest.fixture(scope="module")
def pairs():
    """The two environments of each scene: the one of opening, and the one of closing."""
    return {
        scene: [
            PAIRS.make(f"{scene}-{direction}-hidden", num_points=64)
            for direction in ("open", "close")
        ]
        for scene in SCENES
    }


@pytest.fixture(scope="module")
def turned():
    """(skill, angle) -> environment."""
    return {
        (skill, angle): CONVENTIONS.make(f"{skill}-turned-{angle:06.2f}", num_points=64)
        for skill, angle in (("reach", 0), ("reach", 123.75), ("push", 123.75))
    }


def play(env, seed, actions=None):
    """Plays an episode with these actions, or with the expert's.

    Returns the actions, what each step told, and the last observation.
    """
    env.begin(seed)
    taken, infos = [], []
    truncated = False
    while not truncated:
        action = env.expert_action() if actions is None else actions[len(taken)]
        _, truncated, info = env.advance(action)
        taken.append(action)
        infos.append(info)
    return np.array(taken), infos, env.observe()


def begins_elsewhere(simulator, start):
    """Asserts that demonstrations and rollouts all begin at places of their own."""
    demonstrations = [
        demonstration_seed(simulator, task, 0, attempt)
        for task in simulator.instructions
        for attempt in range(20)
    ]
    rollouts = [evaluation_seed(seed, i) for seed in range(20) for i in range(20)]
    places = [tuple(start(seed).tolist()) for seed in demonstrations + rollouts]
    assert len(set(places)) == len(demonstrations) + len(rollouts)


# ---- Pairs ---------------------------------------------------------------------------------------


def test_both_tasks_of_a_pair_have_one_instruction_that_does_not_tell_which():
    assert simulator_of("pairs") == PAIRS
    tasks, novel = PAIRS.tasks("pairs")
    assert tasks == [
        f"{scene}-{direction}-hidden"
        for scene, direction in product(("faucet", "drawer"), ("open", "close"))
    ]
    assert novel == []
    for opened, closed in (tasks[:2], tasks[2:]):
        assert PAIRS.instructions[opened] == PAIRS.instructions[closed]
    for word in ("open", "close", "clockwise", "pull", "push"):
        assert word not in " ".join(PAIRS.instructions.values()).lower()


@pytest.mark.parametrize("scene", SCENES)
def test_both_tasks_of_a_pair_begin_alike_and_go_on_alike_with_the_same_actions(pairs, scene):
    for seed in (3, 10**8):
        observations = []
        for env in pairs[scene]:
            env.begin(seed + 1)  # what was before does not matter
            env.begin(seed)
            observations.append([env.observe()])
            rng = np.random.default_rng(seed)
            for _ in range(10):
                env.advance(rng.uniform(-1, 1, 4))
            observations[-1].append(env.observe())
        for of_open, of_close in zip(*observations):
            for name, x in of_open.items():
                assert np.array_equal(x, of_close[name])
    env = pairs[scene][0]
    joint = env.sawyer_env.data.joint(SCENES[scene].joint)
    env.begin(seed)
    begun = env.observe()
    assert joint.qpos == SCENES[scene].joint_start and abs(joint.qvel) < 1e-9
    env.begin(4)
    assert not np.array_equal(begun["point_cloud"], env.observe()["point_cloud"])
    assert np.abs(begun["agent_pos"] - env.observe()["agent_pos"]).max() > 0.01


def test_the_drawer_is_half_open(pairs):
    for env in pairs["drawer"]:
        env.begin(0)
        low, high = env.sawyer_env.model.joint("goal_slidey").range
        assert env.sawyer_env.data.joint("goal_slidey").qpos == (low + high) / 2


@pytest.mark.parametrize("scene", SCENES)
def test_neither_task_of_a_pair_is_achieved_at_the_beginning(pairs, scene):
    for env in pairs[scene]:
        for seed in range(3):
            env.begin(seed)
            assert env.other_successes == []
            _, _, info = env.advance(np.zeros(4))
            assert info == {"success": False, "other_success": False}


@pytest.mark.parametrize("scene", SCENES)
def test_experts_of_pairs_solve_their_own_task_and_not_the_others(pairs, scene):
    """By the environment of either task: that of the other one says of each step the opposite."""
    for env, other in (pairs[scene], pairs[scene][::-1]):
        actions, infos, _ = play(env, seed=100)
        assert infos[-1]["success"] and len(infos) == PAIRS.episode_steps
        assert not any(info["other_success"] for info in infos)
        joint = env.sawyer_env.data.joint(SCENES[scene].joint)
        travel = float(joint.qpos[0]) - SCENES[scene].joint_start
        assert travel / LEAST_TRAVEL[env.task] > 1

        _, infos_of_other, _ = play(other, seed=100, actions=actions)
        assert not any(info["success"] for info in infos_of_other)
        assert other.other_successes == [info["success"] for info in infos]


@pytest.mark.parametrize("scene", SCENES)
def test_clouds_of_pairs_lack_the_markers_and_nothing_else(pairs, scene):
    """Those of goals and those at the handle's end; the fingers are marked alike in both tasks."""
    for env in pairs[scene]:
        env.begin(0)
        model, data = env.sawyer_env.model, env.sawyer_env.data
        whole_camera = env.make_camera(CAMERA_PIXELS)
        markers = [
            site
            for site in whole_camera.sites
            if model.site(site).name.startswith(("goal", "handleStart"))
        ]
        assert len(markers) == {"faucet": 4, "drawer": 1}[scene]
        assert {*env.camera.sites} == {*whole_camera.sites} - {*markers}

        # The drawer hides its goal, so that is moved to beside the hand, where it would be seen.
        data.site_xpos[markers[0]] = data.body("hand").xpos + [0.0, 0.1, 0.05]
        whole, hits = whole_camera.points(data, segmentation=True)
        of_markers = np.isin(hits - model.ngeom, markers)
        seen = env.camera.points(data)
        assert of_markers.any()
        missing = {*map(tuple, whole.tolist())} - {*map(tuple, seen.tolist())}
        assert missing == {*map(tuple, whole[of_markers].tolist())}


@pytest.mark.parametrize("scene", SCENES)
def test_what_is_to_be_moved_is_seen(pairs, scene):
    """By 15 rays at least, so that it is seen where it is."""
    env, _ = pairs[scene]
    model = env.sawyer_env.model
    body = model.jnt_bodyid[model.joint(SCENES[scene].joint).id]
    for seed in range(3):
        env.begin(seed)
        _, hits = env.camera.points(env.sawyer_env.data, segmentation=True)
        assert (model.geom_bodyid[hits[hits < model.ngeom]] == body).sum() >= 15


@pytest.mark.parametrize("scene", SCENES)
def test_demonstrations_and_rollouts_of_pairs_begin_at_different_places(scene):
    def start(seed):
        return np.concatenate(unnamed_tasks.pair_start(scene, seed))

    begins_elsewhere(PAIRS, start)


def test_where_there_are_no_novel_tasks_nobody_can_ask_for_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    simulator = simulator_of("pairs")
    args = evaluate.parse(["--split", "novel"])
    trained = {"suite": "pairs", "arguments": {}}  # what a checkpoint says
    with pytest.raises(evaluate.UserError, match="pairs has no novel tasks"):
        evaluate.choose_tasks(args, simulator, "pairs", trained)
    with pytest.raises(evaluate.UserError, match="pairs has no novel tasks"):
        finetune.choose_tasks(["novel"], simulator, "pairs")
    with pytest.raises(evaluate.UserError, match="pairs has no novel tasks"):
        train.main(["--suite", "pairs", "--preset", "tiny", "--evaluate-on", "novel"])
    args = evaluate.parse(["--split", "all"])
    tasks = evaluate.choose_tasks(args, simulator, "pairs", trained)
    assert evaluate.group_tasks(tasks, simulator, "pairs") == {"mean": tasks}


# ---- Turned actions ------------------------------------------------------------------------------


def test_angles_to_train_on_to_choose_by_and_to_measure_on_are_disjoint():
    assert simulator_of("convention-push") == CONVENTIONS
    for skill in ("reach", "push"):
        base, novel = CONVENTIONS.tasks(f"convention-{skill}")
        again, validation = CONVENTIONS.tasks(f"convention-{skill}-validation")
        assert (len(base), len(validation), len(novel)) == (16, 4, 8) and base == again
        assert len({*base, *validation, *novel}) == 28
        assert {*base, *validation, *novel} <= {*CONVENTIONS.instructions}
        assert len({CONVENTIONS.instructions[task] for task in base + novel + validation}) == 1
        angles = {task: angle_of(task) for task in base + validation + novel}
        for task in validation + novel:  # in the middle between two of the others
            distances = [abs((angles[task] - angles[b] + 180) % 360 - 180) for b in base]
            assert sorted(distances)[:2] == [11.25, 11.25]
    assert base[1] == "push-turned-022.50" and novel[0] == "push-turned-011.25"
    assert angles["push-turned-022.50"] == 22.5
    assert np.array_equal(np.diff(ANGLES["base"]), [22.5] * 15) and ANGLES["base"][0] == 0


def test_turning_forth_and_back_is_the_identity_and_keeps_the_norm():
    rng = np.random.default_rng(0)
    for angle in (0.0, 11.25, 123.75, 270.0):
        for _ in range(20):
            action = bound_norm(rng.uniform(-1, 1, 4))
            turned = turn(action, angle)
            np.testing.assert_allclose(turn(turned, -angle), action, atol=1e-6)
            np.testing.assert_allclose(np.hypot(*turned[:2]), np.hypot(*action[:2]), atol=1e-6)
            np.testing.assert_allclose(turned[2:], action[2:], atol=1e-6)
            assert np.abs(turned).max() <= 1
    np.testing.assert_allclose(turn([1, 0, 0.5, -1], 90), [0, 1, 0.5, -1], atol=1e-6)
    np.testing.assert_allclose(bound_norm([3, 4, 0.5, -1]), [0.6, 0.8, 0.5, -1])
    np.testing.assert_allclose(bound_norm([0.3, 0.4, 0.5, -1]), [0.3, 0.4, 0.5, -1])


def test_an_action_may_be_longer_than_one_and_is_then_shortened_before_it_is_turned(turned):
    """Were it cut to [-1, 1] after turning, it would have another direction."""
    env = turned["reach", 123.75]
    hands = []
    for length in (1.0, 1.4):
        env.begin(0)
        for _ in range(5):
            env.advance(np.array([0.6 * length, 0.8 * length, 0, 0]))
        hands.append(env.observe()["agent_pos"][:3])
    np.testing.assert_allclose(*hands, atol=1e-6)


@pytest.mark.parametrize("skill", ["reach", "push"])
def test_an_expert_reaches_the_goal_in_its_turned_frame_and_not_if_nothing_is_turned_back(
    turned, skill, monkeypatch
):
    env = turned[skill, 123.75]
    actions, infos, _ = play(env, seed=5)
    assert infos[-1]["success"] and len(infos) == CONVENTIONS.episode_steps
    assert np.abs(actions).max() <= 1
    monkeypatch.setattr(env, "angle", 0.0)
    _, infos, _ = play(env, seed=5, actions=actions)
    assert not any(info["success"] for info in infos)


def test_the_world_sees_the_same_at_each_angle_though_actions_differ(turned):
    straight, _, end = play(turned["reach", 0], seed=5)
    actions, _, turned_end = play(turned["reach", 123.75], seed=5)
    np.testing.assert_allclose(turned_end["agent_pos"], end["agent_pos"], atol=1e-4)
    angles = [np.arctan2(a[:, 1], a[:, 0]) for a in (actions, straight)]
    moving = np.hypot(*straight[:, :2].T) > 0.1
    degrees = np.rad2deg(angles[0] - angles[1])[moving] % 360
    assert moving.sum() > 10
    np.testing.assert_allclose(degrees, 123.75, atol=0.1)


def test_the_goal_is_seen(turned):
    for env in turned.values():
        for seed in range(4):
            env.begin(seed)
            model, data = env.sawyer_env.model, env.sawyer_env.data
            _, hits = env.camera.points(data, segmentation=True)
            assert (hits == model.ngeom + model.site("goal").id).sum() >= 2
            nearest = np.linalg.norm(env.cloud() - data.site("goal").xpos, axis=1).min()
            assert nearest <= model.site("goal").size[0] + 1e-3


def test_the_hand_begins_elsewhere_in_every_episode_and_that_tells_nothing_of_the_goal(turned):
    begins_elsewhere(CONVENTIONS, unnamed_tasks.hand_start)
    env = turned["reach", 0]
    hands = []
    for seed in (0, 1):
        env.begin(seed)
        hands.append(env.observe()["agent_pos"][:3])
        np.testing.assert_allclose(hands[-1], unnamed_tasks.hand_start(seed), atol=0.02)

    starts, drawn = [], []
    for seed in range(400):
        env.sawyer_env.np_random = np.random.default_rng(seed)  # as SawyerXYZEnv.seed does
        starts.append(unnamed_tasks.hand_start(seed))
        drawn.append(env.sawyer_env._get_state_rand_vec())  # object (3,) and goal (3,)
    drawn = np.array(drawn)[:, [0, 1, 3, 4, 5]]  # objects have one height
    related = np.corrcoef(np.array(starts).T, drawn.T)[:3, 3:]
    assert np.abs(related).max() < 0.2


def test_recordings_keep_what_ends_in_success_and_are_never_augmented(turned):
    assert PAIRS.recipe["success"] == CONVENTIONS.recipe["success"] == "at the end"
    assert CONVENTIONS.recipe["positions_in_state"] == 0  # so that no map moves them
    assert PAIRS.recipe["simulator"] != CONVENTIONS.recipe["simulator"]
    arrays, _ = record_episode(turned["push", 123.75], seed=5, at_end=True)
    assert arrays["points"].shape == (100, 64, 3) and arrays["state"].shape == (100, 9)
    for suite in ("convention-reach", "convention-push"):
        settings = replace(train.SETTINGS["small"], suite=suite, **train.SUITE_SETTINGS[suite])
        assert not settings.augment and settings.instruction_dropout == 0
        assert (settings.demonstrations, settings.tasks_per_step) == (8, None)
        assert (settings.evaluate_on, CONVENTIONS.demonstrations) == ("novel", 5)
    settings = replace(train.SETTINGS["small"], **train.SUITE_SETTINGS["pairs"])
    assert (settings.instruction_dropout, settings.evaluate_on) == (0, "base")


@pytest.mark.parametrize("suite", UNNAMED_SUITES)
def test_the_queue_shows_each_task_the_demonstration_of_one_that_contradicts_it(suite):
    plan = plan_of(suite)
    for flags in plan.variants.values():
        train.parse(flags.split())  # exits if one is unknown
    named = []
    for report in plan.reports.values():
        assert set(report.variants) <= set(plan.variants)
        if "--swap demonstration" in report.command:
            tasks = re.search(r"--task (.*?) --", report.command)[1].split()
            # task -> the one whose demonstration it is shown
            shown = evaluate.of_next_task(dict(zip(tasks, tasks)))
            named += tasks
            for task, other in shown.items():
                if suite == "pairs":
                    assert other == unnamed_tasks.other_of_pair(task)
                else:
                    apart = abs(angle_of(task) - angle_of(other))
                    assert min(apart, 360 - apart) >= 135
    base, novel = simulator_of(suite).tasks(suite)
    assert sorted(named) == sorted(base if suite == "pairs" else novel)
