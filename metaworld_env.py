"""Meta-World as point clouds: its suites, the language instructions, the environment, the experts.

    env = gymnasium.make("DAMI/MetaWorld-v0", task="reach")  # after `import metaworld_env`

An observation is a cloud of N points and the positions of the end effector and the two fingers,
world frame, metres. The clouds come from rays that camera.py casts. Class `MetaWorld` is what
simulator.py knows of all this.

Letters: N points of an observation.
"""

import copy
import warnings
from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np
from metaworld import env_dict
from metaworld.policies import ENV_POLICY_MAP

from camera import RayCastCamera, geoms_of
from common import choose
from data import farthest_point_sample
from simulator import OutOfSightError

# Some experts ask for more than 1; their actions are clipped below.
warnings.filterwarnings("ignore", message=r"Constant\(s\) may be too high")

# ---- Suites and instructions ---------------------------------------------------------------------

SUITES = {"ml10": env_dict.ML10_V3, "ml45": env_dict.ML45_V3}  # as `metaworld` itself splits them

INSTRUCTIONS = {
    "assembly": "Pick up the ring by its handle and slide it over the peg.",
    "basketball": "Pick up the ball and drop it through the basketball hoop.",
    "bin-picking": "Take the cube out of one bin and put it into the other bin.",
    "box-close": "Pick up the lid by its handle and place it on the box.",
    "button-press": "Push the button on the front of the machine all the way in.",
    "button-press-topdown": "Press the button on top of the machine down from above.",
    "button-press-topdown-wall": "Reach over the wall and press the button on top of the machine "
    "down from above.",
    "button-press-wall": "Reach around the wall and push the button on the front of the "
    "machine in.",
    "coffee-button": "Press the button of the coffee machine.",
    "coffee-pull": "Pull the mug away from the coffee machine to the marked spot.",
    "coffee-push": "Push the mug under the coffee machine to the marked spot.",
    "dial-turn": "Turn the dial by half a revolution.",
    "disassemble": "Grasp the ring by its handle and lift it off the peg.",
    "door-close": "Push the open door of the safe until it is shut.",
    "door-lock": "Turn the knob on the door down so that the door is locked.",
    "door-open": "Pull the door of the safe open by its handle.",
    "door-unlock": "Turn the knob on the door aside so that the door is unlocked.",
    "drawer-close": "Push the open drawer back into the cabinet.",
    "drawer-open": "Pull the drawer out of the cabinet by its handle.",
    "faucet-close": "Turn the handle of the faucet clockwise to close it.",
    "faucet-open": "Turn the handle of the faucet counterclockwise to open it.",
    "hammer": "Pick up the hammer and drive the nail into the board.",
    "hand-insert": "Move the gripper down into the hole in the table.",
    "handle-press": "Push the long handle in front of you down.",
    "handle-press-side": "Push the handle that points sideways down.",
    "handle-pull": "Pull the long handle in front of you up.",
    "handle-pull-side": "Pull the handle that points sideways up.",
    "lever-pull": "Lift the lever until it points straight up.",
    "peg-insert-side": "Pick up the peg and push it sideways into the hole of the box.",
    "peg-unplug-side": "Pull the peg sideways out of the box.",
    "pick-out-of-hole": "Pick the puck out of the hole and lift it to the marked spot.",
    "pick-place": "Pick up the puck and hold it at the marked spot.",
    "pick-place-wall": "Pick up the puck, lift it over the wall and hold it at the marked spot.",
    "plate-slide": "Slide the plate away from the robot into the cabinet.",
    "plate-slide-back": "Slide the plate out of the cabinet toward the robot.",
    "plate-slide-back-side": "Slide the plate sideways out of the cabinet.",
    "plate-slide-side": "Slide the plate sideways into the cabinet.",
    "push": "Push the puck over the table to the marked spot.",
    "push-back": "Pull the block back over the table to the marked spot.",
    "push-wall": "Push the puck around the wall to the marked spot.",
    "reach": "Move the gripper to the marked spot.",
    "reach-wall": "Move the gripper over the wall to the marked spot.",
    "shelf-place": "Pick up the cube and place it on the shelf.",
    "soccer": "Push the ball into the goal.",
    "stick-pull": "Pick up the stick, hook the container with it and pull the container "
    "to the marked spot.",
    "stick-push": "Pick up the stick and push the container with it to the marked spot.",
    "sweep": "Sweep the cube off the side of the table.",
    "sweep-into": "Sweep the cube into the hole in the table.",
    "window-close": "Slide the window shut by its handle.",
    "window-open": "Slide the window open by its handle.",
}

# ---- Environment ---------------------------------------------------------------------------------

CAMERA = "corner2"
CAMERA_POSITION = (0.6, 0.295, 0.8)  # world frame, metres; the orientation stays Meta-World's
CAMERA_PIXELS = 96  # height and width
ARM_LINKS = tuple(f"right_l{i}" for i in range(7))  # bodies, without the hand and its fingers
RENDER_PIXELS = 240
WORKSPACE = ((-0.55, 0.3, -0.05), (0.6, 1.0, 0.48))  # the table and its holes, below the upper arm
NUM_POINTS = 512
EPISODE_STEPS = 200
# Won by bringing the fingertips, or what they hold, to the goal.
FINGERTIP_TASKS = ("reach", "reach-wall", "pick-place", "pick-place-wall")
REST_AFTER = 20  # after so many steps of success in a row the expert rests
REST_GAIN = 10.0  # of a resting hand, action per metre, as of the experts of push and pick-place

# How recordings are made. One that was made in another way is refused by `simulator.collect`.
RECIPE = {
    "simulator": "meta-world",
    "camera": [CAMERA, list(CAMERA_POSITION), CAMERA_PIXELS],
    "arm": "seen where nothing else is",
    "workspace": [list(corner) for corner in WORKSPACE],
    "num_points": NUM_POINTS,
    "sampling": "farthest points",
    "expert": "Meta-World's, with the fingertips at the goal of reach and pick-place",
    "rests_after": REST_AFTER,
    "positions_in_state": 3,  # hand and fingers; actions begin with a displacement of the hand
}


class MetaWorldPointCloudEnv(gymnasium.Env):
    """A Meta-World task as a point cloud; also `gymnasium.make("DAMI/MetaWorld-v0", task="reach")`.

    Observation: "point_cloud" (N, 3) float32 and "agent_pos" (9,) float32, the positions of the end
    effector, the right and the left finger; world frame, metres. A cloud is a farthest point
    sample of objects, goal marker and gripper. The arm hides what is behind it and gives no points,
    unless nothing else can be seen.

    Action (4,) in [-1, 1]: dx, dy, dz in centimetres, gripper (1 closes).

    Episodes are truncated after `episode_steps` and never terminate. Each step tells
    info["success"], and an episode succeeds if any of its steps does. Objects and goals are drawn
    from the seed of an episode alone: the same seed gives the same episode.

    Args:
        task: one of INSTRUCTIONS. Raises UserError for another, with the nearest right one.
        num_points: N.
        render_mode: None or "rgb_array". `render` draws a picture in both cases.
        episode_steps: the length of an episode.
    """

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 80}
    rest_after: ClassVar[int | None] = REST_AFTER  # None: the expert never rests
    camera_pixels: ClassVar[int] = CAMERA_PIXELS
    hidden_sites: ClassVar[Collection[str]] = ()  # what clouds and pictures do not show

    def __init__(
        self,
        task: str,
        num_points: int = NUM_POINTS,
        render_mode: str | None = None,
        *,
        episode_steps: int = EPISODE_STEPS,
    ):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is {render_mode!r}; it can be None or 'rgb_array'")
        self.task = choose(task, INSTRUCTIONS, "task")
        self.num_points = num_points
        self.render_mode = render_mode
        self.episode_steps = episode_steps
        self.steps = 0  # since the beginning of the episode
        self.successes_in_a_row = 0  # up to the present moment
        self.resting_place: np.ndarray | None = None  # (3,) of the hand, where the expert rests
        self.gripper = 0.0  # the last number of the last action

        sawyer_env = make_sawyer_env(task)
        sawyer_env._set_task_called = True
        sawyer_env._freeze_rand_vec = False  # draw objects and goals at each reset ...
        sawyer_env.seeded_rand_vec = True  # ... from a generator of its own, not NumPy's global
        sawyer_env._partially_observable = False  # the expert needs the goal
        sawyer_env.max_path_length = episode_steps  # Meta-World's own is 500
        # It was cached while the goal was hidden, and would clip the goal to 0.
        del sawyer_env.sawyer_observation_space
        sawyer_env.touching_object = partial(touching_object, sawyer_env)
        self.sawyer_env = sawyer_env
        self.expert = ENV_POLICY_MAP[f"{task}-v3"]()
        self.expert_brings_fingertips = task in FINGERTIP_TASKS

        model = sawyer_env.model
        model.camera(CAMERA).pos[:] = CAMERA_POSITION
        self.arm_geoms = np.flatnonzero(geoms_of(model, ARM_LINKS))
        self.camera = self.make_camera(self.camera_pixels, self.hidden_sites)
        self.observation_space = gymnasium.spaces.Dict(
            {
                "point_cloud": gymnasium.spaces.Box(-np.inf, np.inf, (num_points, 3), np.float32),
                "agent_pos": gymnasium.spaces.Box(-np.inf, np.inf, (9,), np.float32),
            }
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)

    def make_camera(self, pixels: int, hidden_sites: Collection[str] = ()) -> RayCastCamera:
        """Makes a camera of `pixels` rows and columns that sees the workspace.

        Sites of the names in `hidden_sites`, such as goal markers, are hidden from this camera
        alone.
        """
        model = self.sawyer_env.model
        # The floor, the table and its walls: bodies with a geom as wide as the workspace.
        (low, *_), (high, *_) = WORKSPACE
        wide = 2 * model.geom_size[:, 0] >= high - low

        return RayCastCamera(
            model,
            CAMERA,
            height=pixels,
            width=pixels,
            box=WORKSPACE,
            background=np.unique(model.geom_bodyid[wide]),
            hidden_sites=[i for i in range(model.nsite) if model.site(i).name in hidden_sites],
            ellipsoids=ARM_LINKS,
        )

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Begins an episode; without a seed one is drawn. Returns (observation, info)."""
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**31))
        self.begin(seed)
        return self.observe(), {"success": False}

    def begin(self, seed: int) -> None:
        """Begins the episode of this seed without casting rays."""
        self.expert_observation = self.reset_simulation(seed)
        self.steps = 0
        self.successes_in_a_row = 0
        self.resting_place = None

    def reset_simulation(self, seed: int) -> np.ndarray:
        """Puts everything where the episode of this seed begins.

        Returns what the expert reads, Meta-World's own observation (39,) float64.
        """
        self.sawyer_env.seed(seed)
        expert_observation, _ = self.sawyer_env.reset()
        # Moves the goal markers to this episode's goal: they are still where the last one had them.
        mujoco.mj_forward(self.sawyer_env.model, self.sawyer_env.data)
        return expert_observation

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        """Takes one step: `advance`, then `observe`.

        Returns (observation, reward, False, truncated, info). Raises ValueError for an action that
        is not four finite numbers, and OutOfSightError where nothing is seen.
        """
        reward, truncated, info = self.advance(action)
        return self.observe(), reward, False, truncated, info

    def advance(self, action: np.ndarray) -> tuple[float, bool, dict]:
        """Takes one step without casting rays. Returns (reward, truncated, info).

        Raises ValueError for an action that is not four finite numbers.
        """
        action = np.asarray(action, dtype=np.float32)
        if action.shape != (4,) or not np.isfinite(action).all():
            raise ValueError(f"an action is four finite numbers, not {action}")

        action = np.clip(action, -1, 1)
        self.expert_observation, reward, _, _, info = self.sawyer_env.step(action)
        self.steps += 1
        self.successes_in_a_row = self.successes_in_a_row + 1 if info["success"] else 0
        self.gripper = float(action[3])
        if self.rest_after is None or self.successes_in_a_row < self.rest_after:
            self.resting_place = None
        elif self.resting_place is None:
            self.resting_place = self.hand()
        truncated = self.steps >= self.episode_steps
        return float(reward), truncated, {"success": bool(info["success"])}

    def hand(self) -> np.ndarray:
        """Returns the position of the hand (3,), world frame, metres."""
        return self.sawyer_env.data.body("hand").xpos.copy()

    def observe(self) -> dict[str, np.ndarray]:
        """Casts the rays and returns the observation of the present moment.

        Raises OutOfSightError where nothing is seen.
        """
        data = self.sawyer_env.data
        right_finger = data.site("rightEndEffector").xpos
        left_finger = data.site("leftEndEffector").xpos
        positions = np.concatenate([self.hand(), right_finger, left_finger])  # (9,)
        return {"point_cloud": self.cloud(), "agent_pos": positions.astype(np.float32)}

    def state_without_goal(self) -> np.ndarray:
        """Returns Meta-World's own observation (39,) float32, in which zeros stand for the goal.

        It is what Meta-World's benchmarks show to a learner: positions, of this moment and of the
        one before. rl.py reads it.
        """
        return np.append(self.expert_observation[:-3], np.zeros(3)).astype(np.float32)

    def cloud(self) -> np.ndarray:
        """Returns farthest points of what the camera sees of all but the arm, (N, 3) float32.

        Where it sees fewer than N points, they are repeated from the first one. Where the arm hides
        everything else, the points are the arm's. Raises OutOfSightError where nothing is seen.
        """
        points, geoms = self.camera.points(self.sawyer_env.data, segmentation=True)
        if len(points) == 0:
            raise OutOfSightError(f"{self.task}: nothing was seen inside the workspace")
        of_arm = np.isin(geoms, self.arm_geoms)  # (M,) bool
        if not of_arm.all():
            points = points[~of_arm]
        return farthest_point_sample(points, self.num_points)

    def expert_action(self) -> np.ndarray:
        """Returns the scripted expert's action (4,) float32 in [-1, 1] for the present moment.

        After `rest_after` steps of success in a row it rests: it keeps the hand where it is then,
        and the gripper as it is. Meta-World's experts go on, and some undo what they did: that of
        door-open lets the door go, and that of window-open pushes to and fro. To keep the hand in
        its place takes small actions. An action of zero is no rest: the simulator's arm follows a
        target that actions move, and where it lags behind, as it does with a puck in its grip, it
        goes on for a centimetre and more.

        Reach is a success where the fingertips are within 5 cm of the goal, and pick-place where
        the puck between them is within 7 cm. But Meta-World's experts bring the hand there, which
        is 4.5 cm above the fingertips: what is left is half a centimetre in reach, and 2.5 cm in
        pick-place. So the goal that they are told is raised by as much.
        """
        if self.resting_place is not None:
            displacement = REST_GAIN * (self.resting_place - self.hand())
            action = np.append(displacement, self.gripper)
            return np.clip(action, -1, 1).astype(np.float32)
        observation = self.expert_observation.copy()
        if self.expert_brings_fingertips:
            # The last three numbers are the goal.
            observation[-3:] += self.hand() - self.sawyer_env.tcp_center
        return np.clip(self.expert.get_action(observation), -1, 1).astype(np.float32)

    def render(self) -> np.ndarray:
        """Returns a picture (240, 240, 3) uint8 from the camera of the point clouds."""
        picture = self.camera.render(self.sawyer_env.data, RENDER_PIXELS, RENDER_PIXELS)
        return picture[::-1, ::-1].copy()  # Meta-World's corner cameras hang upside down

    def close(self) -> None:
        self.sawyer_env.close()


@lru_cache(maxsize=4)  # few, since they are large
def compile_scene(path: str) -> mujoco.MjModel:
    """The scene that a file of MuJoCo describes."""
    return mujoco.MjModel.from_xml_path(path)


def make_sawyer_env(task: str) -> Any:
    """Makes Meta-World's environment of a task.

    Four fifths of the time would go into compiling its scene. That is done once in a process, and
    every environment gets a copy of the result.
    """

    class SawyerEnv(env_dict.ALL_V3_ENVIRONMENTS[f"{task}-v3"]):
        def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
            model = copy.copy(compile_scene(self.fullpath))
            return model, mujoco.MjData(model)

    return SawyerEnv()


def touching_object(sawyer_env: Any, object_geom_id: int) -> bool:
    """Whether both fingers press on the geom of this number.

    It replaces Meta-World's method of this name, and returns the same. The original goes through
    all contacts in Python, which takes half the time of a step of pick-place.
    """
    data = sawyer_env.data
    geoms = data.contact.geom  # (contacts, 2)
    of_object = (geoms == object_geom_id).any(axis=1)

    def force(pad: str) -> float:  # with which a finger's pad and the object press on each other
        of_both = of_object & (geoms == data.geom(pad).id).any(axis=1)
        return data.efc_force[data.contact.efc_address[of_both]].sum()

    return bool(force("leftpad_geom") > 0 and force("rightpad_geom") > 0)


if "DAMI/MetaWorld-v0" not in gymnasium.registry:
    gymnasium.register("DAMI/MetaWorld-v0", entry_point=f"{__name__}:MetaWorldPointCloudEnv")

# ---- For simulator.py ----------------------------------------------------------------------------


@dataclass(frozen=True)
class MetaWorld:
    """Meta-World as a `simulator.Simulator`."""

    episode_steps: int = EPISODE_STEPS
    name: ClassVar[str] = RECIPE["simulator"]
    instructions: ClassVar[dict[str, str]] = INSTRUCTIONS
    recipe: ClassVar[dict] = RECIPE
    packages: ClassVar[tuple[str, ...]] = ("metaworld", "mujoco")
    demonstrations: ClassVar[int] = 10

    def tasks(self, suite: str) -> tuple[list[str], list[str]]:
        """Returns the (base, novel) tasks of "ml10" or "ml45"."""
        split = SUITES[suite]
        base = [name.removesuffix("-v3") for name in split["train"]]
        novel = [name.removesuffix("-v3") for name in split["test"]]
        return base, novel

    def make(self, task: str, num_points: int) -> MetaWorldPointCloudEnv:
        """Makes an environment of a task whose clouds have `num_points` points."""
        return MetaWorldPointCloudEnv(task, num_points, episode_steps=self.episode_steps)
