"""Meta-World as point clouds: suites, a ray-cast camera, the environment, expert demonstrations, files and windows.

    python data.py --suite ml10                 # collect 10 expert demonstrations of each of ML10's 15 tasks into data/
    python data.py --show data/reach.npz        # draw one of them to a PNG

An observation is a cloud of N points (world frame, metres) and the positions of the end effector and the two fingers.
The camera casts rays (`mujoco.mj_multiRay`) instead of rasterizing, so nothing here needs OpenGL or a GPU.

Letters: B windows, T demonstration frames, F stored frames, N points, To=2 observation steps, H=16 horizon,
Ta=8 executed actions, A=4 action dim, S=9 state dim, R rays, M points before sampling.
"""

from __future__ import annotations

import argparse
import difflib
import json
import multiprocessing
import os
import signal
import sys
import time
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from importlib.metadata import version
from itertools import zip_longest
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import fpsample
import gymnasium
import mujoco
import numpy as np
import torch
from metaworld import env_dict
from metaworld.policies import ENV_POLICY_MAP
from tqdm import tqdm

warnings.filterwarnings("ignore", message=r"Constant\(s\) may be too high")  # the experts' actions are clipped below

EPISODE_STEPS = 200
EPISODE_SEEDS = 100_000  # episodes one run seed may draw
TASK_SEEDS = 2_000  # of them, those of one task's demonstrations
RUN_SEEDS = 1_000  # run seeds 0 ... 999: demonstrations use episode seeds below 10**8, evaluation those from 10**8


class InputError(ValueError):
    """Something the user gave cannot be used; the message says what to do."""


# ---------------------------------------------------------------------------------------------------------------------
# Suites, tasks, instructions

SUITES = {"ml10": env_dict.ML10_V3, "ml45": env_dict.ML45_V3}

INSTRUCTIONS = {
    "assembly": "Pick up the ring by its handle and slide it over the peg.",
    "basketball": "Pick up the ball and drop it through the basketball hoop.",
    "bin-picking": "Take the cube out of one bin and put it into the other bin.",
    "box-close": "Pick up the lid by its handle and place it on the box.",
    "button-press": "Push the button on the front of the machine all the way in.",
    "button-press-topdown": "Press the button on top of the machine down from above.",
    "button-press-topdown-wall": "Reach over the wall and press the button on top of the machine down from above.",
    "button-press-wall": "Reach around the wall and push the button on the front of the machine in.",
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
    "stick-pull": "Pick up the stick, hook the container with it and pull the container to the marked spot.",
    "stick-push": "Pick up the stick and push the container with it to the marked spot.",
    "sweep": "Sweep the cube off the side of the table.",
    "sweep-into": "Sweep the cube into the hole in the table.",
    "window-close": "Slide the window shut by its handle.",
    "window-open": "Slide the window open by its handle.",
}


def choose(name: str, names: Iterable[str], what: str) -> str:
    """Return `name` if it is one of `names`; otherwise raise InputError with the nearest right one."""
    names = sorted(names)
    if name in names:
        return name
    near = difflib.get_close_matches(str(name), names, n=1, cutoff=0.4)
    advice = f"did you mean {near[0]!r}?" if near else f"choose one of: {', '.join(names)}"
    raise InputError(f"unknown {what} {name!r}: {advice}")


def suite_tasks(suite: str) -> tuple[list[str], list[str]]:
    """Return the (base, novel) task names of "ml10" or "ml45", as `metaworld` itself splits them, without "-v3"."""
    split = SUITES[choose(suite, SUITES, "suite")]
    return [name.removesuffix("-v3") for name in split["train"]], [name.removesuffix("-v3") for name in split["test"]]


def check_task(task: str) -> str:
    """Return `task` if it is one of the 50; otherwise raise InputError with the nearest right one."""
    return choose(task, INSTRUCTIONS, "task")


def demonstration_seed(task: str, seed: int, attempt: int) -> int:
    """Episode seed of one attempt at a demonstration; below 10**8, so never one of `evaluation_seed`.

    It differs from task to task: some draw their goals alike, and would show the same ten.
    """
    return episode_seed(seed, TASK_SEEDS * list(INSTRUCTIONS).index(task) + attempt)


def evaluation_seed(seed: int, episode: int) -> int:
    """Episode seed of one evaluation rollout; at least 10**8, so its goals were in no demonstration."""
    return RUN_SEEDS * EPISODE_SEEDS + episode_seed(seed, episode)


def episode_seed(seed: int, episode: int) -> int:
    """Below RUN_SEEDS * EPISODE_SEEDS = 10**8."""
    if not 0 <= seed < RUN_SEEDS or not 0 <= episode < EPISODE_SEEDS:
        raise InputError(f"seed {seed} is out of range: use a seed from 0 to {RUN_SEEDS - 1}")
    return seed * EPISODE_SEEDS + episode


# ---------------------------------------------------------------------------------------------------------------------
# Camera and point clouds

CAMERA = "corner2"
CAMERA_POSITION = (0.6, 0.295, 0.8)  # world frame, metres; the orientation and the field of view stay Meta-World's
CAMERA_PIXELS = 84
WORKSPACE = ((-0.55, 0.3, -0.05), (0.6, 1.0, 0.48))  # world frame, metres: the table and its holes, below the upper arm
CORNERS = np.array([[bit >> axis & 1 for axis in range(3)] for bit in range(8)], dtype=bool)  # of a box: high or low
RENDER_PIXELS = 240
SKY = (0.75, 0.85, 0.95)
LIGHT = (0.4, -0.5, 0.77)  # direction towards the light, unit length within 1 %


def geom_colors(model: mujoco.MjModel) -> np.ndarray:
    """Return the color (geoms, 4) RGBA in [0, 1] MuJoCo draws each geom in; a texture counts with its mean."""
    colors = model.geom_rgba.astype(np.float64)
    for geom, material in enumerate(model.geom_matid):
        if material < 0 or (model.geom_rgba[geom] != (0.5, 0.5, 0.5, 1)).any():
            continue  # a color of its own goes before the material's
        colors[geom] = model.mat_rgba[material]
        texture = model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB]
        if texture >= 0:
            start, channels = model.tex_adr[texture], model.tex_nchannel[texture]
            size = model.tex_height[texture] * model.tex_width[texture] * channels
            texels = model.tex_data[start : start + size].reshape(-1, channels)
            colors[geom, :3] *= texels[::16, :3].mean(axis=0) / 255
    return colors


class RayCastCamera:
    """A fixed pinhole camera that casts rays at the visible geoms and sphere sites of a MuJoCo model.

    MuJoCo's own rays pass through sites, yet Meta-World draws its goals as sphere sites, so those are intersected here.
    Visible means what MuJoCo's renderer shows by default: groups 0 to 2, alpha above 0.

    Arguments: `model`; `pixels`, height and width of the square image; `box`, ((x, y, z) low, (x, y, z) high) of the
    workspace, world frame, metres; `camera`, a camera of the model that is attached to the world; `position`, where it
    is moved (world frame, metres; None leaves it).
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        pixels: int = CAMERA_PIXELS,
        box: tuple[Sequence[float], Sequence[float]] = WORKSPACE,
        camera: str = CAMERA,
        position: Sequence[float] | None = CAMERA_POSITION,
    ) -> None:
        self.model = model
        self.pixels = pixels
        self.low, self.high = np.array(box, dtype=np.float64)
        index = model.camera(camera).id
        if model.cam_bodyid[index] != 0:
            raise ValueError(f"camera {camera!r} moves with a body; a fixed one is needed")
        if position is not None:
            model.cam_pos[index] = position  # in the model, so that MuJoCo's renderer would see the same
        self.origin = model.cam_pos[index].copy()
        self.tan = np.tan(np.deg2rad(model.cam_fovy[index]) / 2)
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.cam_quat[index])
        self.rotation = rotation.reshape(3, 3)  # columns: right, up, backward
        self.groups = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)
        self.colors = geom_colors(model)  # (geoms, 4)
        model.geom_group[self.colors[:, 3] == 0] = 5  # MuJoCo's rays would still hit some geoms its renderer leaves out
        self.sites = np.flatnonzero(
            (model.site_type == mujoco.mjtGeom.mjGEOM_SPHERE)
            & (model.site_group <= 2)
            & (model.site_rgba[:, 3] > 0)
            & (model.site_size[:, 0] > 0)
        )
        self.half = model.geom_aabb[:, 3:].copy()  # half sizes of the geoms' bounding boxes
        self.middle = model.geom_aabb[:, :3].copy()
        planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        self.half[planes], self.middle[planes] = (1e3, 1e3, 0), 0
        self.scenery = np.zeros(model.ngeom, dtype=bool)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        low, high = self.bounds(data)
        for body in np.flatnonzero(model.body_weldid == 0):  # what does not move and is as wide as the workspace:
            geoms = (model.geom_bodyid == body) & (model.geom_group <= 2)  # floor, table, walls
            if geoms.any():
                width = high[geoms, 0].max() - low[geoms, 0].min()
                self.scenery[geoms] = width >= self.high[0] - self.low[0]
        self.objects = np.flatnonzero((model.geom_group <= 2) & ~self.scenery)
        rays = self.rays(pixels)  # (pixels**2, 3)
        with np.errstate(divide="ignore"):
            near, far = (self.low - self.origin) / rays, (self.high - self.origin) / rays  # (pixels**2, 3)
        enter = np.minimum(near, far).max(axis=1)  # where a ray enters and leaves the box, metres
        leave = np.maximum(near, far).min(axis=1)
        meets = leave > np.maximum(enter, 0)
        self.all_rays, self.meets = rays, meets  # (pixels**2, 3), (pixels**2,)
        self.cutoff = leave[meets].max() if meets.any() else 0.0

    def rays(self, pixels: int) -> np.ndarray:
        """Return unit directions (pixels**2, 3) in the world frame through the pixels, row by row from the top."""
        across = self.tan * ((np.arange(pixels) + 0.5) / pixels * 2 - 1)
        x, y = np.meshgrid(across, -across)
        rays = np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3) @ self.rotation.T
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def cast(
        self,
        data: mujoco.MjData,
        rays: np.ndarray,
        cutoff: float = 1e3,
        sites: np.ndarray | None = None,
        geoms: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Cast unit `rays` (R, 3) from the camera at the geoms no farther than `cutoff` and at `sites` (None: all).

        `geoms` (geoms,) bool: at these alone, as far as they are visible (None: all).

        Returns the distances (R,) in metres, inf where nothing is hit, and what was hit (R,): a geom's index, -1 for
        nothing, or -2 - index of a site.
        """
        count = len(rays)
        hit = np.full(count, -1, dtype=np.int32)
        distance = np.full(count, -1.0)
        groups = self.model.geom_group.copy()
        if geoms is not None:
            self.model.geom_group[~geoms] = 5  # rays pass through this one
        mujoco.mj_multiRay(
            self.model, data, self.origin, rays.ravel(), self.groups, 1, -1, hit, distance, count, cutoff
        )
        self.model.geom_group[:] = groups
        hit[distance < 0] = -1
        distance[distance < 0] = np.inf
        for site in self.sites if sites is None else sites:
            to_center, radius = data.site_xpos[site] - self.origin, self.model.site_size[site, 0]
            along = rays @ to_center  # (R,) |t d - to_center| = radius with |d| = 1: t = along - sqrt(inside)
            inside = along**2 - (to_center @ to_center - radius**2)
            near = np.flatnonzero((inside >= 0) & (along > 0))
            t = along[near] - np.sqrt(inside[near])
            closer = t < distance[near]
            distance[near[closer]] = t[closer]
            hit[near[closer]] = -2 - site
        return distance, hit

    def bounds(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Return the low and high corners (geoms, 3), (geoms, 3) of boxes around the geoms, world frame, metres."""
        rotation = data.geom_xmat.reshape(-1, 3, 3)
        middle = data.geom_xpos + (rotation @ self.middle[..., None])[..., 0]
        half = (np.abs(rotation) @ self.half[..., None])[..., 0]
        return middle - half, middle + half

    def points(self, data: mujoco.MjData) -> np.ndarray:
        """Return the visible points (M, 3) float32 of all but the scenery inside the workspace, world frame, metres."""
        # Most rays end on the table. Only those are cast whose pixels lie in a rectangle around some object or marker.
        low, high = self.bounds(data)
        radius = self.model.site_size[self.sites, :1]
        low = np.concatenate([low[self.objects], data.site_xpos[self.sites] - radius])
        high = np.concatenate([high[self.objects], data.site_xpos[self.sites] + radius])
        low, high = np.maximum(low, self.low), np.minimum(high, self.high)
        near = (low < high).all(axis=1)
        corners = np.where(CORNERS, high[near, None], low[near, None])  # (boxes, 8, 3)
        x, y, z = np.moveaxis((corners - self.origin) @ self.rotation, -1, 0)  # camera frame: right, up, backward
        depth = np.maximum(-z, 1e-6)
        columns = ((x / depth / self.tan + 1) / 2 * self.pixels).clip(0, self.pixels)  # (boxes, 8)
        rows = ((1 - y / depth / self.tan) / 2 * self.pixels).clip(0, self.pixels)
        left, right, top, bottom = columns.min(axis=1), columns.max(axis=1), rows.min(axis=1), rows.max(axis=1)
        wanted = np.zeros((self.pixels, self.pixels), dtype=bool)
        for box in zip(top.astype(int), np.ceil(bottom).astype(int), left.astype(int), np.ceil(right).astype(int)):
            wanted[box[0] : box[1], box[2] : box[3]] = True
        rays = self.all_rays[wanted.ravel() & self.meets]  # (R, 3)

        # The scenery comes last, since most rays meet it and no point of it is wanted: it only hides.
        distance, _ = self.cast(data, rays, self.cutoff, self.sites[near[len(self.objects) :]], ~self.scenery)
        points = self.origin + np.minimum(distance, 1e3)[:, None] * rays  # (R, 3)
        inside = ((points >= self.low) & (points <= self.high)).all(axis=1)
        barrier, _ = self.cast(data, rays[inside], self.cutoff, self.sites[:0], self.scenery)
        return points[inside][distance[inside] <= barrier].astype(np.float32)  # (M, 3)

    def depth(self, data: mujoco.MjData, pixels: int = CAMERA_PIXELS) -> np.ndarray:
        """Return the depth image (pixels, pixels): metres along the viewing direction, inf where nothing is hit."""
        rays = self.rays(pixels)
        distance, _ = self.cast(data, rays)
        return (distance * (rays @ -self.rotation[:, 2])).reshape(pixels, pixels)

    def render(self, data: mujoco.MjData, pixels: int = RENDER_PIXELS) -> np.ndarray:
        """Return a picture (pixels, pixels, 3) uint8: colors of geoms and sites, shaded by the slope of the surface."""
        rays = self.rays(pixels)
        distance, hit = self.cast(data, rays)
        colors = np.concatenate([self.colors[:, :3], self.model.site_rgba[::-1, :3], [SKY]])
        color = colors[hit].reshape(pixels, pixels, 3)  # from the end: -1 is the sky, -2 - i the site i
        seen = np.isfinite(distance)
        points = np.where(seen[:, None], rays * np.where(seen, distance, 10.0)[:, None], 10.0 * rays)
        points = points.reshape(pixels, pixels, 3)
        right = np.diff(points, axis=1, append=2 * points[:, -1:] - points[:, -2:-1])
        up = -np.diff(points, axis=0, append=2 * points[-1:] - points[-2:-1])
        normal = np.cross(right, up)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True) + 1e-12
        shade = 0.55 + 0.45 * (normal @ np.array(LIGHT))
        shade = np.where(seen.reshape(pixels, pixels), shade, 1.0)
        picture = (255 * np.clip(color * shade[..., None], 0, 1)).astype(np.uint8)
        upside_down = self.rotation[2, 1] < 0  # Meta-World's corner cameras hang so
        return picture[::-1, ::-1].copy() if upside_down else picture


def farthest_point_sample(points: np.ndarray, n: int) -> np.ndarray:
    """Sample n of the points (M, 3) float32, each the farthest from all before it.

    Returns (n, 3) float32 in the order of selection, so that the first k of the n are themselves such a sample of k.
    The same cloud always gives the same sample. With M < n the sample is repeated from its beginning.
    Raises ValueError for an empty cloud.
    """
    if len(points) == 0:
        raise ValueError("the cloud is empty: no ray met anything inside the workspace")
    if len(points) < 8:  # too few for a tree of 2**3 buckets
        order = fpsample.fps_sampling(points, min(n, len(points)), start_idx=0)
    else:
        order = fpsample.bucket_fps_kdline_sampling(points, min(n, len(points)), h=3, start_idx=0)
    return points[np.resize(order.astype(np.int64), n)]  # (n, 3)


# ---------------------------------------------------------------------------------------------------------------------
# Environment


class MetaWorldPointCloudEnv(gymnasium.Env):
    """A Meta-World task seen as a point cloud; also `gymnasium.make("DAMI/MetaWorld-v0", task="reach")`.

    Observation: "point_cloud" (N, 3) float32, farthest point sampled, and "agent_pos" (9,) float32: the positions of
    the end effector, the right and the left finger; world frame, metres. Action (4,) in [-1, 1]: dx, dy, dz in
    centimetres, gripper (1 closes). Episodes are truncated at 200 steps and never terminate; each step tells
    info["success"], and the episode's success is that of any of its steps.
    `reset(seed=...)` draws objects and goals from that seed alone: the same seed gives the same episode.
    """

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 80}

    def __init__(self, task: str, num_points: int = 512, render_mode: str | None = None) -> None:
        self.task = check_task(task)
        self.num_points = num_points
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is {render_mode!r}; it can be None or 'rgb_array'")
        self.render_mode = render_mode
        self.simulator = env_dict.ALL_V3_ENVIRONMENTS[f"{task}-v3"]()
        self.simulator._set_task_called = True
        self.simulator._freeze_rand_vec = False  # draw objects and goals at each reset ...
        self.simulator.seeded_rand_vec = True  # ... from the simulator's own generator, not from numpy's global one
        self.simulator._partially_observable = False  # the expert needs the goal
        del self.simulator.sawyer_observation_space  # cached with the goal hidden: steps would clip it to zero
        self.expert = ENV_POLICY_MAP[f"{task}-v3"]()
        self.camera = RayCastCamera(self.simulator.model)
        self.observation_space = gymnasium.spaces.Dict(
            {
                "point_cloud": gymnasium.spaces.Box(-np.inf, np.inf, (num_points, 3), np.float32),
                "agent_pos": gymnasium.spaces.Box(-np.inf, np.inf, (9,), np.float32),
            }
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Begin an episode; without a seed one is drawn. Returns (observation, info)."""
        super().reset(seed=seed)
        self.begin(int(self.np_random.integers(2**31)) if seed is None else seed)
        return self.observe(), {"success": False}

    def begin(self, seed: int) -> None:
        """Begin the episode of this seed without casting rays."""
        self.simulator.seed(seed)
        self.raw, _ = self.simulator.reset()
        mujoco.mj_forward(self.simulator.model, self.simulator.data)  # else the markers are still the last episode's
        self.steps = 0

    def advance(self, action: np.ndarray) -> tuple[float, bool, dict]:
        """Take one step of physics without casting rays. Returns (reward, truncated, info)."""
        action = np.clip(np.asarray(action, dtype=np.float32), -1, 1)
        if action.shape != (4,) or not np.isfinite(action).all():
            raise ValueError(f"an action is four finite numbers, not {action}")
        self.raw, reward, _, _, info = self.simulator.step(action)
        self.steps += 1
        return float(reward), self.steps >= EPISODE_STEPS, {"success": bool(info["success"])}

    def observe(self) -> dict[str, np.ndarray]:
        """Cast the rays and return the observation of the present moment."""
        data = self.simulator.data
        fingers = [data.site("rightEndEffector").xpos, data.site("leftEndEffector").xpos]
        return {
            "point_cloud": farthest_point_sample(self.camera.points(data), self.num_points),
            "agent_pos": np.concatenate([data.body("hand").xpos, *fingers]).astype(np.float32),
        }

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        """`advance`, then `observe`."""
        reward, truncated, info = self.advance(action)
        return self.observe(), reward, False, truncated, info

    def expert_action(self) -> np.ndarray:
        """Return the scripted expert's action (4,) float32 in [-1, 1] for the present moment."""
        return np.clip(self.expert.get_action(self.raw), -1, 1).astype(np.float32)

    def render(self) -> np.ndarray | None:
        """Return a picture (240, 240, 3) uint8 from the camera of the point clouds."""
        return self.camera.render(self.simulator.data) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        self.simulator.close()


if "DAMI/MetaWorld-v0" not in gymnasium.registry:
    gymnasium.register("DAMI/MetaWorld-v0", entry_point=f"{__name__}:MetaWorldPointCloudEnv")


# ---------------------------------------------------------------------------------------------------------------------
# Demonstrations and their files


@dataclass
class Demonstrations:
    """Recorded episodes of one task, one after the other; see `check` for the shapes and units."""

    task: str
    instruction: str
    points: np.ndarray  # (F, N, 3) float16, world frame, metres, in the order of farthest point sampling
    state: np.ndarray  # (F, S) float32
    action: np.ndarray  # (F, A) float32, in [-1, 1]
    episode_ends: np.ndarray  # (E,) int64: one past the last frame of each episode
    meta: dict  # how they were made

    def __len__(self) -> int:
        return len(self.episode_ends)

    def episode(self, index: int) -> slice:
        """Return the frames of one episode."""
        return slice(int(self.episode_ends[index - 1]) if index else 0, int(self.episode_ends[index]))

    def first(self, n: int | None) -> Demonstrations:
        """Return the first n episodes (views, no copies); None: all."""
        if n is None:
            return self
        if not 1 <= n <= len(self):
            raise InputError(f"{n} demonstrations of {self.task} were asked for, but there are {len(self)}")
        end = self.episode(n - 1).stop
        return Demonstrations(
            self.task,
            self.instruction,
            self.points[:end],
            self.state[:end],
            self.action[:end],
            self.episode_ends[:n],
            self.meta,
        )

    def check(self, name: str) -> None:
        """Raise InputError, with `name` in it, for what cannot be trained on."""
        for field, dims in (("points", 3), ("state", 2), ("action", 2)):
            array = getattr(self, field)
            if array.ndim != dims or not np.issubdtype(array.dtype, np.floating) or 0 in array.shape[1:]:
                raise InputError(f"{name}: {field} must be {dims}-dimensional floats, not {array.dtype} {array.shape}")
        frames, ends = len(self.points), self.episode_ends
        if self.points.shape[2] != 3:
            raise InputError(f"{name}: points must be (frames, points, 3), not {self.points.shape}")
        if ends.ndim != 1 or not np.issubdtype(ends.dtype, np.integer) or (np.diff(ends, prepend=0) <= 0).any():
            raise InputError(f"{name}: episode_ends must be growing whole numbers, one past each episode's last frame")
        if len(ends) == 0:
            raise InputError(f"{name} holds no episodes: record or collect it again")
        if not frames == len(self.state) == len(self.action) == ends[-1]:
            raise InputError(
                f"{name}: lengths differ: {frames} frames of points, {len(self.state)} of state, "
                f"{len(self.action)} of action, episode_ends up to {ends[-1]}"
            )
        successes = self.meta.get("success_frames")
        positions = self.meta.get("positions_in_state", 0)
        if type(positions) is not int or not 0 <= 3 * positions <= self.state.shape[1]:
            raise InputError(
                f"{name}: positions_in_state is {positions!r}, with {self.state.shape[1]} numbers in a state"
            )
        if positions and self.action.shape[1] < 3:
            raise InputError(f"{name}: with positions_in_state an action must begin with a displacement")
        listed = isinstance(successes, list) and all(type(frame) is int and frame >= 0 for frame in successes)
        if successes is not None and not (listed and len(successes) >= len(ends)):
            raise InputError(f"{name}: success_frames must be a list with one whole number for each episode")
        for field in ("points", "state", "action"):
            if not np.isfinite(getattr(self, field)).all():
                raise InputError(f"{name}: {field} holds NaN or infinite numbers: record or collect it again")


FIELDS = ("task", "instruction", "points", "state", "action", "episode_ends", "meta")


def save_demonstrations(path: str | Path, demonstrations: Demonstrations) -> None:
    """Write one task's demonstrations as an `.npz` file, atomically: a failure leaves an older file as it was."""
    demonstrations.check(str(path))
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {field: getattr(demonstrations, field) for field in FIELDS}
    arrays["meta"] = json.dumps(demonstrations.meta)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(temporary, "wb") as file:
            np.savez(file, **arrays)  # compressed: half the size, six times the loading time
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def load_demonstrations(path: str | Path) -> Demonstrations:
    """Read what `save_demonstrations`, or a user's own recorder, wrote.

    Raises InputError, one line, for a file that is missing, truncated, of another kind, inconsistent or not finite.
    """
    path = Path(path)
    if not path.is_file():
        hint = f": collect it with `python data.py --task {path.stem}`" if path.stem in INSTRUCTIONS else ""
        raise InputError(f"{path} is missing{hint}")
    if not zipfile.is_zipfile(path):
        raise InputError(f"{path} is truncated or no .npz file: delete it and collect it again")
    try:
        with np.load(path, allow_pickle=False) as file:
            if missing := [field for field in FIELDS if field not in file.files]:
                raise InputError(f"{path} is no file of demonstrations: it lacks {', '.join(missing)}")
            arrays = {field: file[field] for field in FIELDS}
        meta = dict(json.loads(str(arrays["meta"])))
    except InputError:
        raise
    except (ValueError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path} is damaged or no file of demonstrations: {error}") from None
    demonstrations = Demonstrations(
        str(arrays["task"]), str(arrays["instruction"]), *(arrays[field] for field in FIELDS[2:6]), meta
    )
    demonstrations.check(str(path))
    return demonstrations


def own_recordings(folder: str | Path) -> dict[str, Path]:
    """Return task -> file of the recordings in a folder, if there are any and none is of a Meta-World task; else {}."""
    paths = {path.stem: path for path in sorted(Path(folder).glob("*.npz"))}
    return {} if set(paths) & set(INSTRUCTIONS) else paths


# ---------------------------------------------------------------------------------------------------------------------
# Collection with the scripted experts

NUM_POINTS = 512
ATTEMPTS_PER_EPISODE = 20
RECIPE = {
    "made_by": "data.collect",
    "camera": [CAMERA, list(CAMERA_POSITION), CAMERA_PIXELS],
    "workspace": [list(corner) for corner in WORKSPACE],
    "num_points": NUM_POINTS,
    "sampling": "farthest points",
    "positions_in_state": 3,  # of hand and fingers: they move with the scene, and actions begin with a displacement
}


worker = SimpleNamespace(stop=None, finished=None)  # what a collecting process shares with the one that started it


def start_worker(stop, finished) -> None:
    """Set up a collecting process: `stop` is an event, `finished` a queue that gets a task's name for each episode."""
    worker.stop, worker.finished = stop, finished
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the starting process's business: it sets `stop`


def record_episode(
    env: MetaWorldPointCloudEnv, seed: int, stop: Callable[[], bool] = lambda: False
) -> tuple[dict, int] | None:
    """Let the expert act for one episode; return its arrays and the frame in which it first succeeded.

    None if it never did, or `stop()` was true.
    """
    env.begin(seed)
    points, state, action, success = [], [], [], None
    for frame in range(EPISODE_STEPS):
        if stop():
            return None
        observation = env.observe()
        points.append(observation["point_cloud"].astype(np.float16))
        state.append(observation["agent_pos"])
        action.append(env.expert_action())
        if env.advance(action[-1])[2]["success"] and success is None:
            success = frame
    return None if success is None else ({"points": points, "state": state, "action": action}, success)


def collect_task(task: str, path: Path, episodes: int, seed: int) -> Path | None:
    """Record `episodes` successful episodes of one task into a file; in a worker process."""
    start, frames, ends, seeds, successes, attempt = time.perf_counter(), {}, [], [], [], 0
    env = MetaWorldPointCloudEnv(task, NUM_POINTS)
    while len(seeds) < episodes:
        if attempt >= ATTEMPTS_PER_EPISODE * episodes:
            raise InputError(f"{task}: the expert succeeded in {len(seeds)} of {attempt} episodes; try another --seed")
        episode_seed = demonstration_seed(task, seed, attempt)
        episode = record_episode(env, episode_seed, worker.stop.is_set)
        if worker.stop.is_set():
            return None
        attempt += 1
        if episode is not None:
            for field, values in episode[0].items():
                frames.setdefault(field, []).extend(values)
            ends.append(len(frames["action"]))
            seeds.append(episode_seed)
            successes.append(episode[1])
            worker.finished.put(task)
    meta = RECIPE | {
        "seed": seed,
        "episode_seeds": seeds,
        "success_frames": successes,
        "expert_success_rate": len(seeds) / attempt,
        "seconds": round(time.perf_counter() - start, 1),
        "versions": {package: version(package) for package in ("metaworld", "mujoco", "fpsample", "numpy")},
    }
    arrays = {field: np.stack(values) for field, values in frames.items()}
    save_demonstrations(
        path, Demonstrations(task, INSTRUCTIONS[task], **arrays, episode_ends=np.array(ends, np.int64), meta=meta)
    )
    return path


def collect(
    tasks: Sequence[str], folder: str | Path, episodes: int = 10, seed: int = 0, workers: int | None = None
) -> dict[str, Path]:
    """Collect expert demonstrations of each task, a process a task at a time; return the file of each.

    Files that already hold enough episodes of the same recipe and seed are kept; those with fewer are made again.
    Raises InputError for a file there that was recorded otherwise: it is never overwritten.
    """
    if episodes < 1:
        raise InputError(f"--episodes is {episodes}: use at least 1")
    if workers is not None and workers < 1:
        raise InputError(f"--workers is {workers}: use at least 1")
    episode_seed(seed, 0)  # refuses a seed out of range
    paths = {check_task(task): Path(folder) / f"{task}.npz" for task in tasks}
    missing = []
    for task, path in paths.items():
        if path.exists():
            old = load_demonstrations(path)
            if old.task != task or old.meta | RECIPE != old.meta or old.meta.get("seed") != seed:
                raise InputError(f"{path} was recorded otherwise (task, camera or seed): move it or use another --data")
            if len(old) >= episodes:
                continue
        missing.append(task)
    if not missing:
        return paths
    workers = min(workers or os.cpu_count() or 1, len(missing))
    context = multiprocessing.get_context("spawn")
    stop, finished = context.Event(), context.SimpleQueue()
    with (
        ProcessPoolExecutor(workers, context, start_worker, (stop, finished)) as pool,
        tqdm(total=len(missing) * episodes, desc="collecting", unit="episode", dynamic_ncols=True) as progress,
    ):
        try:
            pending = {pool.submit(collect_task, task, paths[task], episodes, seed) for task in missing}
            while pending:
                done, pending = wait(pending, timeout=0.5, return_when=FIRST_COMPLETED)
                while not finished.empty():
                    progress.set_postfix_str(finished.get())
                    progress.update()
                for future in done:
                    future.result()
        except BrokenProcessPool:
            raise InputError("a collecting process was killed, perhaps for memory: try fewer --workers") from None
        except BaseException:
            stop.set()
            pool.shutdown(cancel_futures=True)
            raise
    return paths


# ---------------------------------------------------------------------------------------------------------------------
# Windows

SHIFT, TURN, STRETCH = (0.1, 0.1, 0.05), np.radians(10), 0.1  # metres along each axis, radians, share: at most


def random_maps(n: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Draw n affine maps of space, x -> x A^T + b: a shear and stretch, a turn about the vertical, a shift.

    Returns A (n, 3, 3) and b (n, 1, 3), float32, metres; the middle of the workspace is what is turned about.
    """
    symmetric = lambda *shape: 2 * torch.rand(shape, generator=generator, device=generator.device).cpu() - 1  # noqa: E731
    angle, zero, one = TURN * symmetric(n), torch.zeros(n), torch.ones(n)
    cos, sin = angle.cos(), angle.sin()
    turn = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], dim=-1).view(n, 3, 3)
    a = turn @ (torch.eye(3) + STRETCH * symmetric(n, 3, 3))
    middle = torch.tensor(WORKSPACE).mean(dim=0, keepdim=True)  # (1, 3)
    b = middle - middle @ a.mT + torch.tensor(SHIFT) * symmetric(n, 3)[:, None]
    return a, b


class WindowSampler:
    """Windows of `horizon` actions that begin with `n_obs_steps` observations, drawn from one task's demonstrations.

    A window may begin n_obs_steps - 1 frames before an episode and end n_action_steps - 1 frames after it, the edge
    frames repeated: 193 windows in an episode of 200 frames. The clouds are held once, as float16, on `device`.
    Arguments: `num_points`, how many of each cloud's points are used (the first, a farthest point sample themselves);
    `demo_stride`, every how many frames `demonstration` takes one; `after_success`, how many frames after its episode's
    first success a window may begin, where the demonstrations' `meta` tells that frame (None: any number); `augment`,
    whether `batch` puts each scene elsewhere by one of `random_maps`, where `meta` tells the positions in a state.
    """

    def __init__(
        self,
        demonstrations: Demonstrations,
        horizon: int = 16,
        n_obs_steps: int = 2,
        n_action_steps: int = 8,
        num_points: int = 512,
        demo_stride: int = 1,
        device: str | torch.device = "cpu",
        after_success: int | None = None,
        augment: bool = False,
    ) -> None:
        if not 1 <= n_action_steps <= horizon - n_obs_steps + 1:
            raise InputError(
                f"{n_action_steps} executed actions do not fit a horizon of {horizon} with {n_obs_steps} observations"
            )
        if num_points > demonstrations.points.shape[1]:
            raise InputError(
                f"{demonstrations.task} was recorded with {demonstrations.points.shape[1]} points, "
                f"but {num_points} are asked for: use a smaller number or collect again"
            )
        self.task, self.instruction = demonstrations.task, demonstrations.instruction
        self.n_obs_steps, self.demo_stride = n_obs_steps, demo_stride
        self.positions = demonstrations.meta.get("positions_in_state", 0) if augment else 0
        self.points = torch.tensor(demonstrations.points[:, :num_points], dtype=torch.float16, device=device)
        self.state = torch.tensor(demonstrations.state, dtype=torch.float32, device=device)  # (F, S)
        self.action = torch.tensor(demonstrations.action, dtype=torch.float32, device=device)  # (F, A)
        self.episodes = [demonstrations.episode(index) for index in range(len(demonstrations))]
        successes = demonstrations.meta.get("success_frames", []) if after_success is not None else []
        windows = []
        for episode, success in zip_longest(self.episodes, successes[: len(self.episodes)]):
            first = episode.start - (n_obs_steps - 1)
            last = max(episode.stop - horizon + n_action_steps - 1, first)
            if success is not None:
                last = min(last, episode.start + success + after_success)
            frames = torch.arange(first, last + 1)[:, None] + torch.arange(horizon)  # (windows, H)
            windows.append(frames.clamp(episode.start, episode.stop - 1))
        self.windows = torch.cat(windows).to(device)  # (W, H) the frame of each action

    def __len__(self) -> int:
        return len(self.windows)

    def sample(self, n: int, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Draw n different windows (with repetition only where there are fewer than n).

        Returns points (n, To, N, 3), state (n, To, S), action (n, H, A), all float32.
        """
        if n <= len(self):
            chosen = torch.randperm(len(self), generator=generator, device=generator.device)[:n]
        else:
            chosen = torch.randint(len(self), (n,), generator=generator, device=generator.device)
        return self.gather(chosen)

    def gather(self, indices: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the windows of these indices (n,), as `sample` does."""
        frames = self.windows[indices.to(self.windows.device)]  # (n, H)
        observed = frames[:, : self.n_obs_steps]  # (n, To)
        return {
            "points": self.points[observed].float(),  # (n, To, N, 3)
            "state": self.state[observed],  # (n, To, S)
            "action": self.action[frames],  # (n, H, A)
        }

    def demonstration(self, episode: torch.Generator | int) -> dict[str, torch.Tensor]:
        """Return one complete episode, drawn by a generator or named by its number, every `demo_stride`-th frame.

        Returns points (T, N, 3), state (T, S), action (T, A), all float32.
        """
        if isinstance(episode, torch.Generator):
            drawn = torch.randint(len(self.episodes), (1,), generator=episode, device=episode.device)
            episode = int(drawn)
        frames = slice(self.episodes[episode].start, self.episodes[episode].stop, self.demo_stride)
        return {"points": self.points[frames].float(), "state": self.state[frames], "action": self.action[frames]}

    def batch(self, n: int, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Draw n windows and one reference demonstration, which may be the one that a window comes from.

        Returns what `sample` does, and demo_points (1, T, N, 3), demo_state (1, T, S), demo_action (1, T, A).
        """
        demo = {name: x[None] for name, x in self.demonstration(generator).items()}
        windows = self.sample(n, generator)
        if self.positions:
            demo, windows = self.elsewhere(demo, generator), self.elsewhere(windows, generator)
        return windows | {f"demo_{name}": x for name, x in demo.items()}

    def elsewhere(self, scenes: dict[str, torch.Tensor], generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Put each of n scenes elsewhere: points (n, T, N, 3), state (n, T, S) and action (n, T', A)."""
        points, state, action = (scenes[name] for name in ("points", "state", "action"))
        a, b = (x.to(points.device) for x in random_maps(len(points), generator))
        place = lambda x: (x.flatten(1, -2) @ a.mT + b).view_as(x)  # noqa: E731
        at = 3 * self.positions
        positions = place(state[..., :at].unflatten(-1, (-1, 3))).flatten(-2)
        moved = (action[..., :3] @ a.mT).clamp(-1, 1)
        return {
            "points": place(points),
            "state": torch.cat([positions, state[..., at:]], dim=-1),
            "action": torch.cat([moved, action[..., 3:]], dim=-1),
        }


# ---------------------------------------------------------------------------------------------------------------------
# Command line


def draw_demonstration(demonstrations: Demonstrations, out: str | Path, episode: int = 0, columns: int = 6) -> None:
    """Draw one demonstration to a picture: its clouds along time, colored by height, and below them the actions."""
    from matplotlib.figure import Figure

    frames = np.arange(len(demonstrations.points))[demonstrations.episode(episode)]
    shown = np.linspace(0, len(frames) - 1, columns).round().astype(int)
    figure = Figure(figsize=(2.6 * columns, 6), layout="constrained")
    grid = figure.add_gridspec(2, columns, height_ratios=(1.5, 1))
    for column, frame in enumerate(shown):
        cloud = demonstrations.points[frames[frame]].astype(np.float32)
        axes = figure.add_subplot(grid[0, column], projection="3d", computed_zorder=False)
        axes.scatter(*cloud.T, c=cloud[:, 2], s=2, cmap="viridis", vmin=0, vmax=WORKSPACE[1][2])
        axes.scatter(*demonstrations.state[frames[frame]].reshape(-1, 3).T, c="red", s=14)  # hand and fingers
        axes.set(xlim=(-0.5, 0.5), ylim=(0.3, 1.0), zlim=(0, 0.5), title=f"frame {frame}")
        axes.set_box_aspect((1.0, 0.7, 0.5), zoom=1.3)
        axes.view_init(35, -30)
        axes.tick_params(labelsize=5, pad=-3)
    axes = figure.add_subplot(grid[1, :])
    names = ("dx", "dy", "dz", "gripper") if demonstrations.action.shape[1] == 4 else ()
    for index, values in enumerate(demonstrations.action[frames].T):
        axes.plot(values, label=names[index] if names else f"action {index}")
    axes.set(xlabel="frame", ylabel="action", xlim=(0, len(frames) - 1))
    axes.legend(loc="upper right", ncols=4)
    figure.suptitle(f"{demonstrations.task}, episode {episode}: {demonstrations.instruction}")
    figure.savefig(out, dpi=110)


def command_line(main: Callable[[], None], *errors: type[Exception]) -> None:
    """Run a script's `main`: what the user can cause ends in one line on stderr and exit code 2, Ctrl-C in 130."""
    warnings.formatwarning = lambda message, *_: f"warning: {message}\n"
    try:
        main()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except (InputError, OSError, *errors) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Collect expert demonstrations of Meta-World tasks, or draw one.")
    parser.add_argument("--suite", default="ml10", help="ml10 or ml45: collect all its tasks (default: ml10)")
    parser.add_argument("--task", help="collect only this task")
    parser.add_argument("--data", default="data", help="folder of the demonstrations (default: data)")
    parser.add_argument("--episodes", type=int, default=10, help="successful episodes per task (default: 10)")
    parser.add_argument("--seed", type=int, default=0, help="0 to 999, of objects and goals (default: 0)")
    parser.add_argument("--workers", type=int, help="processes (default: one per core)")
    parser.add_argument("--show", metavar="FILE", help="draw a file's first demonstration instead of collecting")
    parser.add_argument("--out", help="the picture of --show (default: FILE with .png)")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    args = parse(argv)
    if args.show:
        out = args.out or Path(args.show).with_suffix(".png")
        draw_demonstration(load_demonstrations(args.show), out)
        print(f"wrote {out}")
        return

    tasks = [check_task(args.task)] if args.task else [task for split in suite_tasks(args.suite) for task in split]
    paths = collect(tasks, args.data, args.episodes, args.seed, args.workers)
    print(f"{'task':28}{'episodes':>9}{'expert':>8}{'frames':>8}{'seconds':>9}{'MB':>6}")
    for task, path in paths.items():
        demonstrations = load_demonstrations(path)
        meta = demonstrations.meta
        print(
            f"{task:28}{len(demonstrations):9}{meta['expert_success_rate']:8.0%}{len(demonstrations.points):8}"
            f"{meta['seconds']:9.1f}{path.stat().st_size / 1e6:6.1f}"
        )


if __name__ == "__main__":
    command_line(main)
