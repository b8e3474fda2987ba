"""A stand-in for RLBench: its modules, classes and files, with a scene that is drawn by hand.

Its classes have the names and the interface of RLBench's, and nothing else of it. A scene is a
table top and a box on it; what a camera sees of them is known exactly. The gripper is a point that
goes where it is told to, unless that is too far; a task succeeds where it touches the box.
"""

import pickle
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import PIL.Image

TABLE = 0.75  # height of the table top, metres
BOX = np.array([[0.2, -0.05, TABLE], [0.36, 0.15, 0.9]])  # two corners
NEAR, FAR = 0.01, 3.2
WIDTH, HEIGHT = 64, 48
REACH = 0.3  # metres that the gripper goes at most in one step
CAMERAS = {  # where they stand; all look at the box
    "front": (1.35, 0.0, 1.6),
    "left_shoulder": (-0.3, 0.6, 1.8),
    "right_shoulder": (-0.3, -0.6, 1.8),
    "wrist": (0.3, 0.0, 1.4),
}
DOWN = np.array([0.0, 0.9926, 0.0, 0.1216])  # x, y, z, w: the gripper nearly points down
DOWN /= np.linalg.norm(DOWN)


# ---- What a camera sees --------------------------------------------------------------------------


def axes(position):
    """Right, down and forward of a camera that looks at the middle of the box, (3, 3)."""
    forward = BOX.mean(axis=0) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def camera_misc(camera):
    """What RLBench's misc says: CoppeliaSim's cameras have x to the left, y up, z forward."""
    position = np.array(CAMERAS[camera])
    right, down, forward = axes(position)
    pose = np.eye(4)
    pose[:3] = np.stack([-right, -down, forward, position], axis=1)
    focal = WIDTH / (2 * np.tan(np.deg2rad(60) / 2))
    return {
        f"{camera}_camera_extrinsics": pose,
        f"{camera}_camera_intrinsics": np.array(
            [[-focal, 0, WIDTH / 2], [0, -focal, HEIGHT / 2], [0, 0, 1]]
        ),
        f"{camera}_camera_near": NEAR,
        f"{camera}_camera_far": FAR,
    }


def rays(camera):
    """The ray of each pixel (H, W, 3), one metre long along the camera's axis."""
    focal = WIDTH / (2 * np.tan(np.deg2rad(60) / 2))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    ones = np.ones_like(rows, float)
    in_camera = np.stack([(columns - WIDTH / 2) / focal, (rows - HEIGHT / 2) / focal, ones], -1)
    return in_camera @ axes(np.array(CAMERAS[camera]))


def depth_of(camera, box=BOX):
    """Metres to table or box along the camera's axis, (H, W); FAR where there is nothing."""
    position, direction = np.array(CAMERAS[camera]), rays(camera)
    with np.errstate(divide="ignore"):
        table = (TABLE - position[2]) / direction[..., 2]
        sides = (box[:, None, None] - position) / direction  # (2, H, W, 3)
    enter, leave = sides.min(axis=0).max(axis=-1), sides.max(axis=0).min(axis=-1)
    metres = np.where(table > 0, table, FAR)
    metres = np.where((enter <= leave) & (enter > 0), np.minimum(metres, enter), metres)
    return np.minimum(metres, FAR)


def encode(metres):
    """Metres -> the image (H, W, 3) uint8 that RLBench writes."""
    code = np.rint((metres - NEAR) / (FAR - NEAR) * (2**24 - 1)).astype(np.int64)
    return np.stack([code >> 16, code >> 8 & 255, code & 255], axis=-1).astype(np.uint8)


def decoded(metres):
    """Metres -> depth from 0 to 1, as the image of it says."""
    return encode(metres).astype(np.int64) @ [65536, 256, 1] / (2**24 - 1)


# ---- Modules and classes -------------------------------------------------------------------------


class Demo:
    def __init__(self, observations):
        self._observations, self.random_seed = observations, np.random.RandomState(0).get_state()


class Observation:
    def __init__(self, **values):
        self.__dict__.update(values)


class InvalidActionError(Exception):
    pass


class Configured:
    """An action mode or a configuration, which keeps what it is given."""

    def __init__(self, *arguments):
        self.arguments = arguments


class ObservationConfig:
    def __init__(self):
        for camera in (*CAMERAS, "overhead"):
            setattr(self, f"{camera}_camera", SimpleNamespace())
        self.set_all(True)

    def set_all(self, value):
        for name, part in vars(self).items():
            if name.endswith("_camera"):
                part.rgb = part.depth = part.mask = part.point_cloud = value
        self.gripper_pose = self.gripper_open = self.joint_positions = value


def observe(config, pose, gripper_open, box):
    """The observation that a configuration asks for."""
    values = {"misc": {"variation_index": 0}, "gripper_pose": None, "gripper_open": None}
    for camera in CAMERAS:
        part = getattr(config, f"{camera}_camera")
        for name in ("rgb", "depth", "mask", "point_cloud"):
            values[f"{camera}_{name}"] = None
        if part.rgb or part.depth:
            values["misc"].update(camera_misc(camera))
        if part.depth:
            values[f"{camera}_depth"] = decoded(depth_of(camera, box)).astype(np.float32)
        if part.rgb:
            values[f"{camera}_rgb"] = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
    if config.gripper_pose:
        values["gripper_pose"] = pose.copy()
    if config.gripper_open:
        values["gripper_open"] = gripper_open
    return Observation(**values)


class TaskEnvironment:
    """One task: `reset` puts the box somewhere, `step` moves the gripper."""

    def __init__(self, environment):
        self.environment, self.variation = environment, None

    def set_variation(self, number):
        self.variation = number

    def reset(self):
        self.box = BOX + [*np.random.uniform(-0.1, 0.1, 2), 0]  # noqa: NPY002
        self.pose, self.gripper_open = np.array([0.28, 0.0, 1.2, *DOWN]), 1.0
        return ["touch the box", "go to the box"], self.observation()

    def observation(self):
        return observe(self.environment.obs_config, self.pose, self.gripper_open, self.box)

    def step(self, action):
        assert action.shape == (8,)
        if not np.isclose(np.linalg.norm(action[3:7]), 1):
            raise InvalidActionError("no unit quaternion")
        if np.linalg.norm(action[:3] - self.pose[:3]) > REACH:
            raise InvalidActionError("too far")
        self.pose, self.gripper_open = action[:7].copy(), float(action[7] > 0.5)
        success = bool(((self.pose[:3] >= self.box[0]) & (self.pose[:3] <= self.box[1])).all())
        return self.observation(), float(success), success


class Environment:
    """Of which a process has one."""

    launched = None

    def __init__(self, action_mode, obs_config, headless):
        self.action_mode, self.obs_config, self.headless = action_mode, obs_config, headless
        self.loaded = []

    def launch(self):
        assert Environment.launched is None and self.headless
        Environment.launched = self

    def get_task(self, task_class):
        self.loaded.append(task_class.__name__)
        return TaskEnvironment(self)

    def shutdown(self):
        pass


def install(monkeypatch, tasks=()):
    """Puts the stand-in where `import rlbench` finds it."""
    contents = {
        "pyrep": {},
        "rlbench": {},
        "rlbench.demo": {"Demo": Demo},
        "rlbench.backend": {},
        "rlbench.backend.observation": {"Observation": Observation},
        "rlbench.backend.exceptions": {"InvalidActionError": InvalidActionError},
        "rlbench.action_modes": {},
        "rlbench.action_modes.action_mode": {"MoveArmThenGripper": Configured},
        "rlbench.action_modes.arm_action_modes": {"EndEffectorPoseViaIK": Configured},
        "rlbench.action_modes.gripper_action_modes": {"Discrete": Configured},
        "rlbench.environment": {"Environment": Environment},
        "rlbench.observation_config": {"ObservationConfig": ObservationConfig},
        "rlbench.tasks": {name: type(name, (), {}) for name in tasks},
    }
    for name, members in contents.items():
        module = ModuleType(name)
        module.__spec__, module.__path__ = ModuleSpec(name, None), []
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
        parent, _, child = name.rpartition(".")
        if parent:
            monkeypatch.setattr(sys.modules[parent], child, module, raising=False)
    monkeypatch.setattr(Environment, "launched", None)
    for cls, module in ((Demo, "rlbench.demo"), (Observation, "rlbench.backend.observation")):
        monkeypatch.setattr(cls, "__module__", module)  # as which it is pickled


# ---- Files ---------------------------------------------------------------------------------------


def path_of_gripper(frames, goal):
    """Poses (T, 7) from above the table to a goal, while the gripper turns and closes."""
    share = np.linspace(0, 1, frames)[:, None]
    places = (1 - share) * np.array([0.28, 0.0, 1.2]) + share * np.array(goal)
    angle = 0.3 * share[:, 0]
    turned = np.stack([np.zeros(frames), DOWN[1] + 0 * angle, angle, DOWN[3] + 0 * angle], axis=1)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return np.concatenate([places, turned], axis=1)


def make_observations(frames, goal=(0.3, 0.05, 0.88), box=BOX, cameras=CAMERAS):
    """The observations of an episode, without images, and the depth of each camera, metres."""
    misc = {"variation_index": 0, "joint_poses": [np.zeros(7)] * 7}
    for camera in cameras:
        misc.update(camera_misc(camera))
    poses = path_of_gripper(frames, goal)
    observations = [
        Observation(
            gripper_pose=pose, gripper_open=float(i < frames - 1), misc=dict(misc), front_rgb=None
        )
        for i, pose in enumerate(poses)
    ]
    return observations, {camera: depth_of(camera, box) for camera in cameras}


def write_episode(folder, observations, depths, protocol=4):
    """An episode's folder, as RLBench's recorder writes it."""
    folder = Path(folder)
    folder.mkdir(parents=True)
    (folder / "low_dim_obs.pkl").write_bytes(pickle.dumps(Demo(observations), protocol))
    for camera, metres in depths.items():
        (folder / f"{camera}_depth").mkdir()
        (folder / f"{camera}_mask").mkdir()
        for i in range(len(observations)):
            PIL.Image.fromarray(encode(metres)).save(folder / f"{camera}_depth" / f"{i}.png")


def write_task(task, episodes=1, frames=4, descriptions=("touch the box", "go to it"), **options):
    """A task's first variation; returns the folder of the variation."""
    variation = Path(task) / "variation0"
    for number in range(episodes):
        observations, depths = make_observations(frames + number, **options)
        write_episode(variation / "episodes" / f"episode{number}", observations, depths)
    (variation / "variation_descriptions.pkl").write_bytes(pickle.dumps(list(descriptions)))
    return variation
