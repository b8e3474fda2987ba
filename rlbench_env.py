"""RLBench's few-shot suite FS25 as point clouds, where CoppeliaSim and RLBench are installed.

    rlbench-generate-dataset --variations 1 --save_path FOLDER    # RLBench's own recorder
    python convert.py --import FOLDER --out data                  # makes a recording of each task
    python train.py --suite fs25                                  # trains on 25 of them

This file was tested against a stand-in that has RLBench's interface. It was never run in
CoppeliaSim.

The paper trains on 25 tasks and adapts to 5 others. It does not say which of a task's variations it
uses; here a task is its first one. Demonstrations are imported, since RLBench plans whole paths and
has no expert that acts step by step. All rollouts of a task are shown the same demonstration, as in
the paper. States, actions and clouds are those of rlbench_data.py, so that recordings and
environment agree.

The seed of an episode sets NumPy's global generator, from which RLBench draws where things are and
which colours they have: the same seed draws the same start. There are two exceptions. RLBench draws
again where its motion planner cannot reach what was drawn, and that planner is a random search
without a seed. And CoppeliaSim promises no equal physics, so that a repeated rollout can end
otherwise.
"""

import atexit
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np

from common import UserError
from data import farthest_point_sample
from rlbench_data import CAMERAS, RECIPE, read_view, seen_points, state_of, target_of
from simulator import OutOfSightError

EPISODE_STEPS = 400  # our choice: 20 seconds, since demonstrations have 20 frames a second
IMAGE_PIXELS = 128  # height and width of all images, as rlbench-generate-dataset has them
RENDER_PIXELS = 240

# FS25_V1 of RLBench, by the names of its tasks: those to train on, and those to adapt to.
BASE = (
    "reach_target",
    "close_box",
    "close_microwave",
    "plug_charger_in_power_supply",
    "toilet_seat_down",
    "take_umbrella_out_of_umbrella_stand",
    "put_umbrella_in_umbrella_stand",
    "slide_cabinet_open",
    "close_fridge",
    "pick_and_lift",
    "open_box",
    "open_microwave",
    "unplug_charger",
    "toilet_seat_up",
    "open_fridge",
    "turn_tap",
    "light_bulb_in",
    "basketball_in_hoop",
    "open_window",
    "close_door",
    "push_button",
    "put_item_in_drawer",
    "open_drawer",
    "close_drawer",
    "turn_oven_on",
)
NOVEL = ("light_bulb_out", "tv_on", "open_oven", "open_door", "take_item_out_of_drawer")

INSTALL = (
    "install CoppeliaSim 4.1, then `pip install git+https://github.com/stepjam/RLBench.git`, as "
    "https://github.com/stepjam/RLBench says"
)


def check_installed() -> None:
    """Raises UserError, which says what to install, where RLBench or its simulator is missing."""
    for package in ("rlbench", "pyrep"):
        if find_spec(package) is None:
            raise UserError(f"the package {package} is not installed: {INSTALL}")


# ---- The simulator of a process ------------------------------------------------------------------

# CoppeliaSim runs once in a process: the launched "environment", the "name" of the task that is
# loaded, its "task", and "episode", the RLBenchEnv that began last.
running: dict[str, Any] = {}


def launch() -> Any:
    """Starts CoppeliaSim without a window, and returns RLBench's `Environment`."""
    try:
        from rlbench.action_modes.action_mode import MoveArmThenGripper
        from rlbench.action_modes.arm_action_modes import EndEffectorPoseViaIK
        from rlbench.action_modes.gripper_action_modes import Discrete
        from rlbench.environment import Environment
        from rlbench.observation_config import ObservationConfig
    except ImportError as error:  # also where the library of CoppeliaSim is not found
        raise UserError(f"RLBench cannot be imported ({error}): {INSTALL}") from error

    observed = ObservationConfig()
    observed.set_all(False)  # above all no masks, whose handles overflow under NumPy 2
    for camera in CAMERAS:
        config = getattr(observed, f"{camera}_camera")
        config.depth, config.image_size = True, (IMAGE_PIXELS, IMAGE_PIXELS)
    observed.front_camera.rgb = True  # for pictures
    observed.gripper_pose = observed.gripper_open = True
    environment = Environment(
        action_mode=MoveArmThenGripper(EndEffectorPoseViaIK(), Discrete()),
        obs_config=observed,
        headless=True,
    )
    environment.launch()
    atexit.register(environment.shutdown)
    return environment


def load_task(name: str) -> Any:
    """Loads a task into the simulator of this process, and returns its `TaskEnvironment`."""
    if "environment" not in running:
        running["environment"] = launch()
    if running.get("name") != name:
        import rlbench.tasks

        class_name = "".join(word.capitalize() for word in name.split("_"))
        task_class = getattr(rlbench.tasks, class_name)
        running.update(name=name, task=running["environment"].get_task(task_class))
    return running["task"]


# ---- Environment ---------------------------------------------------------------------------------


class RLBenchEnv:
    """The first variation of a task of RLBench as a `simulator.Environment`.

    Observations and actions are those of rlbench_data.py: "point_cloud" (N, 3) and "agent_pos" (7,)
    float32, action (7,). Each step is one of RLBench: the arm goes to the pose by inverse
    kinematics, then the gripper opens or closes.

    An episode is over at its success, after `episode_steps`, or where RLBench ends it. It is also
    over, as a failure, with an action that RLBench calls invalid: a pose that the arm cannot reach.

    Args:
        task: one of BASE and NOVEL.
        num_points: N of a cloud.
        episode_steps: the length of an episode.
    """

    def __init__(self, task: str, num_points: int, *, episode_steps: int = EPISODE_STEPS):
        self.task = task
        self.num_points = num_points
        self.episode_steps = episode_steps

    def begin(self, seed: int) -> None:
        """Begins the episode of this seed."""
        self.task_environment = load_task(self.task)
        running["episode"] = self
        np.random.seed(seed)  # noqa: NPY002  RLBench draws from no other generator
        self.task_environment.set_variation(0)
        _, self.observation = self.task_environment.reset()
        self.steps = 0

    def state(self) -> np.ndarray:
        """Returns the present state (7,) float64."""
        return state_of(self.observation.gripper_pose, self.observation.gripper_open)

    def observe(self) -> dict[str, np.ndarray]:
        """Returns the observation of the present moment."""
        views = [
            read_view(
                "RLBench",
                self.observation.misc,
                camera,
                getattr(self.observation, f"{camera}_depth"),
            )
            for camera in CAMERAS
        ]
        points = seen_points(views)
        if len(points) == 0:
            raise OutOfSightError(f"{self.task}: nothing was seen inside the workspace")
        cloud = farthest_point_sample(points, self.num_points)
        return {"point_cloud": cloud, "agent_pos": self.state().astype(np.float32)}

    def advance(self, action: np.ndarray) -> tuple[float, bool, dict]:
        """Takes one step. Returns (reward, truncated, info).

        Raises RuntimeError if another environment of this process has begun an episode since.
        """
        from rlbench.backend.exceptions import InvalidActionError

        if running["episode"] is not self:
            raise RuntimeError("another episode has begun in this process, which has one simulator")
        target = target_of(self.state(), action)
        self.steps += 1
        try:
            self.observation, reward, terminate = self.task_environment.step(target)
        except InvalidActionError:
            return 0.0, True, {"success": False}
        truncated = bool(terminate) or self.steps >= self.episode_steps
        return float(reward), truncated, {"success": bool(reward == 1)}

    def expert_action(self) -> np.ndarray:
        """RLBench has no expert that acts step by step, so that this raises UserError."""
        raise UserError(f"{self.task} has no expert: make its recording by {RECIPE['made_by']}")

    def render(self) -> np.ndarray:
        """Returns a picture (240, 240, 3) uint8 from the front camera."""
        picture = self.observation.front_rgb
        rows, columns = (
            np.arange(RENDER_PIXELS) * size // RENDER_PIXELS for size in picture.shape[:2]
        )
        return picture[rows[:, None], columns]


# ---- For simulator.py ----------------------------------------------------------------------------


@dataclass(frozen=True)
class RLBench:
    """FS25 as a `simulator.Simulator`. Raises UserError where RLBench is not installed."""

    episode_steps: int = EPISODE_STEPS
    name: ClassVar[str] = "rlbench"
    # Recordings have RLBench's own descriptions, which are what policies are told.
    instructions: ClassVar[dict[str, str]] = {
        task: task.replace("_", " ") for task in (*BASE, *NOVEL)
    }
    recipe: ClassVar[dict] = RECIPE
    packages: ClassVar[Sequence[str]] = ("rlbench",)
    demonstrations: ClassVar[int] = 10
    one_environment: ClassVar[bool] = True
    one_demonstration: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_installed()

    def tasks(self, suite: str) -> tuple[list[str], list[str]]:
        """Returns the (base, novel) tasks of "fs25"."""
        return list(BASE), list(NOVEL)

    def make(self, task: str, num_points: int) -> RLBenchEnv:
        """Makes an environment of a task whose clouds have `num_points` points."""
        return RLBenchEnv(task, num_points, episode_steps=self.episode_steps)
