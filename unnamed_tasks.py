"""Tasks that no observation names: pairs of tasks in one scene, and tasks that turn the actions.

    python simulator.py --suite pairs               # demonstrations of its four tasks into data/
    python train.py --suite convention-reach        # trains on 16 angles, measures on 8 new ones

Beside the hidden goals of hidden_goals.py there are two more ways in which an observation can leave
the task open.

`pairs`: the faucet can be opened or closed, and so can the drawer. Both tasks of a pair begin with
the same observation, because the goal's marker is taken out of the cloud and the drawer is half
open. They also have one instruction, which does not say which of the two is meant. There are no
novel tasks.

`convention-reach` and `convention-push`: the goal is seen, but each task turns the x-y part of the
action by an angle of its own. It is like a robot whose base is mounted at an unknown angle. What a
task's actions do can be learned only from observations together with actions: the cloud alone shows
where the hand has to go, and not what moves it there.

The hand begins at another place in every episode. All lengths are metres, in the world frame.
"""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np
from metaworld.sawyer_xyz_env import SawyerXYZEnv

from hidden_goals import CAMERA_PIXELS, HAND_HIGH, HAND_LOW, NUM_POINTS, SMALL_RECIPE, HiddenGoals
from metaworld_env import INSTRUCTIONS, MetaWorldPointCloudEnv, make_sawyer_env

# ---- Pairs of tasks in one scene -----------------------------------------------------------------


@dataclass(frozen=True)
class Scene:
    """A scene in which something can be opened or closed.

    Objects begin where both of Meta-World's tasks may have them, and the hand begins in front of
    them, where it touches nothing.
    """

    instruction: str  # of both tasks
    object_low: tuple[float, float, float]
    object_high: tuple[float, float, float]
    joint: str
    joint_start: float  # where neither task is done; metres or radians


SCENES = {
    "faucet": Scene(
        instruction="Turn the handle of the faucet.",
        object_low=(-0.05, 0.8, 0.0),
        object_high=(0.05, 0.85, 0.0),
        joint="knob_Joint_1",
        joint_start=0.0,
    ),
    "drawer": Scene(
        instruction="Move the drawer.",
        object_low=(-0.1, 0.9, 0.0),
        object_high=(0.1, 0.9, 0.0),
        joint="goal_slidey",
        joint_start=-0.08,  # half open
    ),
}
DIRECTIONS = ("open", "close")
PAIR_HAND_LOW, PAIR_HAND_HIGH = (-0.15, 0.45, 0.2), (0.15, 0.55, 0.3)
MARKERS = ("goal", "goal_open", "goal_close", "handleStartOpen", "handleStartClose")  # sites


def split_pair(task: str) -> tuple[str, str]:
    """Splits the name of a task of a pair: "faucet-open-hidden" -> ("faucet", "open")."""
    scene, direction = task.removesuffix("-hidden").split("-")
    return scene, direction


def other_of_pair(task: str) -> str:
    """Returns the other task of a pair: "faucet-open-hidden" -> "faucet-close-hidden"."""
    scene, direction = split_pair(task)
    return f"{scene}-{'close' if direction == 'open' else 'open'}-hidden"


def pair_start(scene: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns where the object (3,) and the hand (3,) begin in the episode of this seed."""
    rng = np.random.default_rng(seed)
    object_start = rng.uniform(SCENES[scene].object_low, SCENES[scene].object_high)
    return object_start, rng.uniform(PAIR_HAND_LOW, PAIR_HAND_HIGH)


def is_achieved(sawyer_env: SawyerXYZEnv) -> bool:
    """Whether a task of Meta-World is a success in the present state, by its own rule."""
    no_action = np.zeros(4, dtype=np.float32)  # the rules of pairs do not read the action
    _, info = sawyer_env.evaluate_state(sawyer_env._get_obs(), no_action)
    return bool(info["success"])


class PairEnv(MetaWorldPointCloudEnv):
    """One of two tasks that begin with the same observation.

    Observations, actions and success are those of `MetaWorldPointCloudEnv`, without markers in
    clouds and pictures. Each step also tells info["other_success"]: whether the other task of the
    pair is achieved, by its own rule. `other_successes` lists this for each step of the episode.

    Args:
        task: such as "faucet-open-hidden".
        num_points: N of a cloud.
        episode_steps: the length of an episode.
    """

    rest_after = None
    camera_pixels = CAMERA_PIXELS
    hidden_sites = MARKERS

    def __init__(self, task: str, num_points: int = NUM_POINTS, *, episode_steps: int):
        super().__init__(task.removesuffix("-hidden"), num_points, episode_steps=episode_steps)
        self.task = task
        self.scene, _ = split_pair(task)
        self.other_successes: list[bool] = []

        # The other task's environment judges the same simulation: it is given its model and data.
        other_name = other_of_pair(task).removesuffix("-hidden")
        self.other_env = make_sawyer_env(other_name)
        self.other_env._set_task_called = True
        self.other_env.model = self.sawyer_env.model
        self.other_env.data = self.sawyer_env.data

    def begin(self, seed: int) -> None:
        """Begins the episode of this seed without casting rays."""
        super().begin(seed)
        self.other_successes = []

    def reset_simulation(self, seed: int) -> np.ndarray:
        """Puts everything where the episode of this seed begins.

        Returns what the expert reads, Meta-World's own observation (39,) float64.
        """
        object_start, hand = pair_start(self.scene, seed)
        # Both tasks are told where the object begins, since their goals follow from that.
        for env in (self.other_env, self.sawyer_env):
            env.hand_init_pos = hand
            env._freeze_rand_vec = True  # not drawn: the object begins here
            env._last_rand_vec = object_start
            env.reset()

        scene, data = SCENES[self.scene], self.sawyer_env.data
        data.joint(scene.joint).qpos[:] = scene.joint_start
        mujoco.mj_forward(self.sawyer_env.model, data)
        self.sawyer_env._get_obs()  # an observation repeats the one before: both are of this state
        return self.sawyer_env._get_obs()

    def advance(self, action: np.ndarray) -> tuple[float, bool, dict]:
        """Takes one step without casting rays. Returns (reward, truncated, info)."""
        reward, truncated, info = super().advance(action)
        other_success = is_achieved(self.other_env)
        self.other_successes.append(other_success)
        return reward, truncated, {**info, "other_success": other_success}


# ---- Turned actions ------------------------------------------------------------------------------

SKILLS = ("reach", "push")
# The angles of each kind in degrees: for training, for choosing settings, and for results. Each
# angle of the last two kinds lies in the middle between two of the first. Tasks are called after
# them.
ANGLES = {
    "base": [22.5 * i for i in range(16)],
    "validation": [33.75 + 90.0 * i for i in range(4)],
    "novel": [11.25 + 45.0 * i for i in range(8)],
}


def turned_task(skill: str, angle: float) -> str:
    """Returns the name of a task: ("reach", 11.25) -> "reach-turned-011.25"."""
    return f"{skill}-turned-{angle:06.2f}"


def angle_of(task: str) -> float:
    """Returns by how many degrees a task turns actions: "reach-turned-011.25" -> 11.25."""
    return float(task.rsplit("-", 1)[1])


def bound_norm(action: np.ndarray) -> np.ndarray:
    """Shortens the x-y part of an action (4,) to at most 1: turned, it stays within [-1, 1]."""
    action = np.array(action, dtype=np.float64)  # in float32, rounding could leave it longer than 1
    action[:2] /= max(1.0, np.linalg.norm(action[:2]))
    return action


def turn(action: np.ndarray, degrees: float) -> np.ndarray:
    """Turns the x-y part of an action (4,) counterclockwise, seen from above."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    x, y, *others = action
    return np.array([c * x - s * y, s * x + c * y, *others], dtype=np.float32)


def hand_start(seed: int) -> np.ndarray:
    """Returns where the hand begins (3,) in the episode of this seed.

    Meta-World draws object and goal from a generator of the same seed. This one is another, since
    otherwise the hand's place would tell of the goal's.
    """
    return np.random.default_rng((seed, 1)).uniform(HAND_LOW, HAND_HIGH)


class TurnedActionsEnv(MetaWorldPointCloudEnv):
    """A skill whose actions are turned: the world sees the x-y part of an action turned back.

    Everything else is as in `MetaWorldPointCloudEnv`, except that the hand begins elsewhere in
    every episode, and that the x-y part of an action has at most the length 1.

    Args:
        task: such as "reach-turned-011.25".
        num_points: N of a cloud.
        episode_steps: the length of an episode.
    """

    rest_after = None
    camera_pixels = CAMERA_PIXELS

    def __init__(self, task: str, num_points: int = NUM_POINTS, *, episode_steps: int):
        skill, _, _ = task.split("-")
        super().__init__(skill, num_points, episode_steps=episode_steps)
        self.task = task
        self.angle = angle_of(task)

    def begin(self, seed: int) -> None:
        """Begins the episode of this seed without casting rays."""
        self.sawyer_env.hand_init_pos = hand_start(seed)
        super().begin(seed)

    def expert_action(self) -> np.ndarray:
        """Returns the scripted expert's action (4,) float32 in the task's own, turned frame."""
        return turn(bound_norm(super().expert_action()), self.angle)

    def advance(self, action: np.ndarray) -> tuple[float, bool, dict]:
        """Takes one step without casting rays. Returns (reward, truncated, info)."""
        return super().advance(turn(bound_norm(action), -self.angle))


# ---- For simulator.py ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Pairs:
    """Pairs of tasks in one scene as a `simulator.Simulator`."""

    # Experts need 18 to 96. After 140, that of the faucet turns the handle back again.
    episode_steps: int = 120
    name: ClassVar[str] = "meta-world, pairs"
    instructions: ClassVar[dict[str, str]] = {
        f"{scene}-{direction}-hidden": SCENES[scene].instruction
        for scene in SCENES
        for direction in DIRECTIONS
    }
    recipe: ClassVar[dict] = {**SMALL_RECIPE, "simulator": name}
    packages: ClassVar[tuple[str, ...]] = HiddenGoals.packages
    demonstrations: ClassVar[int] = 10

    def tasks(self, suite: str) -> tuple[list[str], list[str]]:
        """Returns the four base tasks of "pairs"; there are no novel ones."""
        return list(self.instructions), []

    def make(self, task: str, num_points: int) -> PairEnv:
        """Makes an environment of a task whose clouds have `num_points` points."""
        return PairEnv(task, num_points, episode_steps=self.episode_steps)


@dataclass(frozen=True)
class Conventions:
    """Skills whose actions are turned as a `simulator.Simulator`."""

    episode_steps: int = 100  # experts need 25 to 85
    name: ClassVar[str] = "meta-world, turned actions"
    instructions: ClassVar[dict[str, str]] = {
        turned_task(skill, angle): INSTRUCTIONS[skill]
        for skill in SKILLS
        for angles in ANGLES.values()
        for angle in angles
    }
    recipe: ClassVar[dict] = {
        **SMALL_RECIPE,
        "simulator": name,
        "positions_in_state": 0,  # an action is no displacement in the frame of the clouds
    }
    packages: ClassVar[tuple[str, ...]] = HiddenGoals.packages
    demonstrations: ClassVar[int] = 5

    def tasks(self, suite: str) -> tuple[list[str], list[str]]:
        """Returns the (base, novel) tasks of "convention-SKILL".

        In "convention-SKILL-validation" other angles stand in the place of the novel ones.
        Settings are chosen on those.
        """
        name = suite.removeprefix("convention-")
        skill = name.removesuffix("-validation")
        others = ANGLES["novel" if name == skill else "validation"]
        base = [turned_task(skill, angle) for angle in ANGLES["base"]]
        return base, [turned_task(skill, angle) for angle in others]

    def make(self, task: str, num_points: int) -> TurnedActionsEnv:
        """Makes an environment of a task whose clouds have `num_points` points."""
        return TurnedActionsEnv(task, num_points, episode_steps=self.episode_steps)
