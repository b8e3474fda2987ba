"""Tasks that no observation names: Meta-World's skills, each with goals that are hidden.

    python simulator.py --suite goals-reach     # demonstrations of all its goals into data/
    python train.py --suite goals-reach         # trains on 160 goals, measures on 20 new ones

In Meta-World's suites the scene tells the task: a policy that ignores its demonstration can still
succeed. Here a task is one goal of one skill, as in Meta-World's own ML1, and the goal's marker is
taken out of the cloud. All goals of a skill have the same instruction, and an episode begins at a
place that says nothing of the goal. Only the demonstration and the windows of an inner step tell
it.

Three things differ from ML1. Goals lie on a wide area, so that the way to one does not pass
another. The hand begins at another place in every episode: from one place for all, a replay of the
demonstration's actions would do. And the object begins in a region so small that Meta-World's rule,
by which object and goal are at least 15 cm apart, never rejects a start: otherwise the start would
depend on the goal.

All lengths are metres, in the world frame.
"""

import zlib
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import gymnasium
import numpy as np

from camera import RayCastCamera
from metaworld_env import INSTRUCTIONS, RECIPE, RENDER_PIXELS, MetaWorldPointCloudEnv

# ---- Goals and starts ----------------------------------------------------------------------------

SKILLS = ("reach", "push", "pick-place")
# How many goals of each kind a skill has: for training, for choosing settings, and for results.
# Tasks are called after them: reach-goal-07, reach-validation-07, reach-novel-07.
NUM_GOALS = {"goal": 320, "validation": 10, "novel": 20}

# Where goals lie: in this box, and so far from the middle of where objects begin, horizontally.
# Objects begin at most hypot(0.05, 0.03) = 0.058 from there: every goal is at least 0.21 - 0.058 =
# 0.152 from the object, more than Meta-World's 0.15.
GOAL_LOW, GOAL_HIGH = (-0.30, 0.50, 0.05), (0.30, 0.90, 0.30)
GOAL_DISTANCE = (0.21, 0.32)
ON_TABLE = 0.02  # the height of the goals of push

# Where the object begins, at most so far from a middle, and the box in which the hand begins.
OBJECT_MIDDLE, OBJECT_SPREAD = (0.0, 0.65), (0.05, 0.03)
HAND_LOW, HAND_HIGH = (-0.15, 0.48, 0.12), (0.15, 0.72, 0.32)

# Only gripper and puck are seen, and fewer rays than in Meta-World's other suites show enough.
CAMERA_PIXELS = 64
NUM_POINTS = 64

# How recordings are made; unnamed_tasks.py has the same.
SMALL_RECIPE = {
    **RECIPE,
    "camera": [*RECIPE["camera"][:2], CAMERA_PIXELS],
    "num_points": NUM_POINTS,
    "success": "at the end",
    "rests_after": None,  # the experts end in success without it
}

# What pictures are drawn from, which show the goal.
PICTURE_POSITION, PICTURE_LOOKAT = (0.35, 1.6, 0.75), (0.0, 0.66, 0.12)


def split_name(task: str) -> tuple[str, str, int]:
    """Splits a task's name: "pick-place-novel-03" -> ("pick-place", "novel", 3)."""
    skill, kind, number = task.rsplit("-", 2)
    return skill, kind, int(number)


def names_of(skill: str, kind: str) -> list[str]:
    """Returns the tasks of a skill that are of one kind, a key of NUM_GOALS."""
    return [f"{skill}-{kind}-{number:02d}" for number in range(NUM_GOALS[kind])]


def goal_of(task: str) -> np.ndarray:
    """Returns the goal of a task (3,), which is drawn from its name."""
    skill, _, _ = split_name(task)
    rng = np.random.default_rng(zlib.crc32(task.encode()))
    nearest, farthest = GOAL_DISTANCE
    while True:
        goal = rng.uniform(GOAL_LOW, GOAL_HIGH)
        if nearest <= np.linalg.norm(goal[:2] - OBJECT_MIDDLE) <= farthest:
            break
    if skill == "push":
        goal[2] = ON_TABLE
    return goal


def start_of(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns where the object (2,) and the hand (3,) begin in the episode of this seed."""
    rng = np.random.default_rng(seed)
    spread = np.array(OBJECT_SPREAD)
    return OBJECT_MIDDLE + rng.uniform(-spread, spread), rng.uniform(HAND_LOW, HAND_HIGH)


# ---- Environment ---------------------------------------------------------------------------------


class HiddenGoalEnv(MetaWorldPointCloudEnv):
    """One goal of a skill, which the cloud does not show; `render` does.

    Observations, actions and success are those of `MetaWorldPointCloudEnv`. An episode's seed
    decides where object and hand begin, and the task where the goal is.

    Args:
        task: such as "reach-goal-07".
        num_points: N of a cloud.
        episode_steps: the length of an episode.
    """

    rest_after = None
    camera_pixels = CAMERA_PIXELS
    hidden_sites = ("goal",)

    def __init__(self, task: str, num_points: int = NUM_POINTS, *, episode_steps: int):
        skill, _, _ = split_name(task)
        super().__init__(skill, num_points, episode_steps=episode_steps)
        self.task = task
        self.skill = skill
        self.goal = goal_of(task)

        # Meta-World clips the goal that its expert reads to the goal space, which is narrower than
        # ours. It is widened here, before the space of observations is made from it and kept.
        low, high = np.array([-1.0, 0.0, 0.0]), np.array([1.0, 1.5, 1.0])
        self.sawyer_env.goal_space = gymnasium.spaces.Box(low, high, dtype=np.float64)

    def change_task(self, task: str) -> bool:
        """Changes to another goal of the same skill, which is quicker than a new environment.

        Returns False, and changes nothing, if the task is of another skill.
        """
        skill, _, _ = split_name(task)
        if skill != self.skill:
            return False
        self.task = task
        self.goal = goal_of(task)
        return True

    @cached_property
    def picture_camera(self) -> RayCastCamera:
        """Faces the robot, whose arm hides half of the goals from Meta-World's corner."""
        return RayCastCamera(
            self.sawyer_env.model, position=PICTURE_POSITION, lookat=PICTURE_LOOKAT
        )

    def begin(self, seed: int) -> None:
        """Begins the episode of this seed without casting rays."""
        sawyer_env = self.sawyer_env
        position, sawyer_env.hand_init_pos = start_of(seed)
        height = sawyer_env.init_config["obj_init_pos"][2]
        sawyer_env._freeze_rand_vec = True  # not drawn: object and goal are these
        sawyer_env._last_rand_vec = np.array([*position, height, *self.goal])
        super().begin(seed)

    def expert_action(self) -> np.ndarray:
        """Returns the scripted expert's action (4,) float32 in [-1, 1] for the present moment.

        Meta-World's expert for push drags the puck with its fingers closed at 0.6 of full force,
        and often loses it on the long ways to these goals: 68 % of its attempts at a demonstration
        succeeded. Here the fingers close at full force, and 95 % do.
        """
        action = super().expert_action()
        if self.skill == "push" and action[3] > 0:
            action[3] = 1.0
        return action

    def render(self) -> np.ndarray:
        """Returns a picture (240, 240, 3) uint8, with the goal's marker in it."""
        return self.picture_camera.render(self.sawyer_env.data, RENDER_PIXELS, RENDER_PIXELS)


# ---- For simulator.py ----------------------------------------------------------------------------


@dataclass(frozen=True)
class HiddenGoals:
    """Skills with hidden goals as a `simulator.Simulator`."""

    episode_steps: int = 100  # experts need 30 to 75
    name: ClassVar[str] = "meta-world, hidden goals"
    instructions: ClassVar[dict[str, str]] = {
        task: INSTRUCTIONS[skill]
        for skill in SKILLS
        for kind in NUM_GOALS
        for task in names_of(skill, kind)
    }
    recipe: ClassVar[dict] = {**SMALL_RECIPE, "simulator": name, "grip": "full force in push"}
    packages: ClassVar[tuple[str, ...]] = ("metaworld", "mujoco")
    demonstrations: ClassVar[int] = 5

    def tasks(self, suite: str) -> tuple[list[str], list[str]]:
        """Returns the (base, novel) goals of "goals-SKILL".

        In "goals-SKILL-validation" other goals stand in the place of the novel ones. Settings are
        chosen on those.
        """
        name = suite.removeprefix("goals-")
        skill = name.removesuffix("-validation")
        others = "novel" if name == skill else "validation"
        return names_of(skill, "goal"), names_of(skill, others)

    def make(self, task: str, num_points: int) -> HiddenGoalEnv:
        """Makes an environment of a task whose clouds have `num_points` points."""
        return HiddenGoalEnv(task, num_points, episode_steps=self.episode_steps)
