"""Meta-World as point clouds: suites, a ray-cast camera, the environment, expert demonstrations.

    python simulator.py --suite ml10        # ten demonstrations of each of its 15 tasks into data/
    python simulator.py --task shelf-place  # of one task

An observation is a cloud of N points and the positions of the end effector and the two fingers,
world frame, metres. The camera casts rays (`mujoco.mj_multiRay`) instead of rasterizing, so nothing
here needs OpenGL or a GPU; it works on any MuJoCo model.

Demonstrations come from Meta-World's scripted experts, who act in `record_episode`. They go into
the files of data.py.

Letters: R rays, M points that the camera sees, N points of an observation.
"""

import argparse
import os
import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import ClassVar

import gymnasium
import mujoco
import numpy as np
from metaworld import env_dict
from metaworld.policies import ENV_POLICY_MAP
from scipy.ndimage import binary_dilation

from data import Demonstrations, farthest_point_sample, load_demonstrations, save_demonstrations
from scripts import at_least, choose, command_line, remove_temporaries, run_jobs, worker

# Some experts ask for more than 1; their actions are clipped below.
warnings.filterwarnings("ignore", message=r"Constant\(s\) may be too high")

# ---- Suites, instructions, seeds -----------------------------------------------------------------

SUITES = {"ml10": env_dict.ML10_V3, "ml45": env_dict.ML45_V3}

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

EPISODE_STEPS = 200
RUN_SEEDS = 1_000  # what a user calls a seed: 0 to 999
EPISODE_SEEDS = 100_000  # of each of them, for its episodes
TASK_SEEDS = 2_000  # of those, for the demonstrations of one task


def suite_tasks(suite: str) -> tuple[list[str], list[str]]:
    """Returns the (base, novel) tasks of "ml10" or "ml45", as `metaworld` itself splits them."""
    split = SUITES[choose(suite, SUITES, "suite")]
    base, novel = ([name.removesuffix("-v3") for name in split[part]] for part in ("train", "test"))
    return base, novel


def check_task(task: str) -> str:
    """Returns `task` if it is one of the 50. Raises ValueError with the nearest right one."""
    return choose(task, INSTRUCTIONS, "task")


def is_simulated(recorded: Demonstrations, path: str | Path) -> bool:
    """Whether a recording is of a task of Meta-World; ValueError if it only has such a name."""
    if recorded.task in INSTRUCTIONS and (other := made_otherwise(recorded, RECIPE)):
        what = f"{path} is not Meta-World's {recorded.task} as recorded here (another {other})"
        raise ValueError(f"{what}: record it again, or give your task, and its file, another name")
    return recorded.task in INSTRUCTIONS


def made_otherwise(recorded: Demonstrations, recipe: dict) -> str:
    """What of a recipe is not as it says, in words; an empty string if all is."""
    found = recorded.meta | {"task": recorded.task}
    return ", ".join(name for name in recipe if found.get(name) != recipe[name])


def own_recordings(folder: str | Path) -> dict[str, Path]:
    """Task -> file of the recordings in a folder; none if they are Meta-World's, by their names."""
    paths = {path.stem: path for path in sorted(Path(folder).glob("*.npz"))}
    known, problem = [task for task in paths if task in INSTRUCTIONS], None
    if Path(folder).is_file():
        problem = f"{folder} is a file: name its folder, all recordings in it are trained on"
    elif not Path(folder).is_dir():
        problem = f"there is no folder {folder}: with --suite ml10, experts fill it"
    elif not paths:
        problem = f"{folder} holds no recordings (.npz): with --suite ml10, experts fill it"
    elif known and len(known) < len(paths):
        problem = f"{folder} mixes your recordings with {known[0]}: move one kind elsewhere"
    if problem:
        raise ValueError(problem)
    for task in known:
        is_simulated(replace(load_demonstrations(paths[task]), task=task), paths[task])
    return {} if known else paths


def episode_seed(seed: int, episode: int) -> int:
    """Returns a number below 10**8 that no other pair of `seed` and `episode` has."""
    if not 0 <= seed < RUN_SEEDS or not 0 <= episode < EPISODE_SEEDS:
        raise ValueError(f"seed {seed} is out of range: use a seed from 0 to {RUN_SEEDS - 1}")
    return seed * EPISODE_SEEDS + episode


def demonstration_seed(task: str, seed: int, attempt: int) -> int:
    """Returns the episode seed of one attempt at a demonstration, below 10**8.

    It differs from task to task: some draw their goals alike, and would show the same ten.
    """
    return episode_seed(seed, TASK_SEEDS * list(INSTRUCTIONS).index(task) + attempt)


def evaluation_seed(seed: int, episode: int) -> int:
    """Returns the episode seed of a rollout, at least 10**8: no demonstration has its goals."""
    return RUN_SEEDS * EPISODE_SEEDS + episode_seed(seed, episode)


# ---- Camera --------------------------------------------------------------------------------------

VISIBLE = np.array([True, True, True, False, False, False])  # which groups MuJoCo's renderer shows
HIDDEN_GROUP = 5
FAR = 1e3  # metres
FEW_RAYS = 32  # what fewer meet is looked at more closely

SKY = (0.75, 0.85, 0.95)
LIGHT = (0.4, -0.5, 0.77)  # direction towards the light, unit length within 1 %


def geom_colors(model: mujoco.MjModel) -> np.ndarray:
    """Returns the RGBA (geoms, 4) in [0, 1] that MuJoCo draws geoms in; of a texture its mean."""
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


def meet_ellipsoid(
    origin: np.ndarray, rays: np.ndarray, center: np.ndarray, axes: np.ndarray, half: np.ndarray
) -> np.ndarray:
    """Where rays (R, 3) from `origin` meet an ellipsoid from outside: (R,) metres, or inf.

    Its axes are columns (3, 3), half as long as `half` (3,) says, metres.
    """
    distance = np.full(len(rays), np.inf)
    along, reach = rays @ (center - origin), half.max()
    away = (center - origin) @ (center - origin)
    near = np.flatnonzero((along > 0) & (along**2 >= away - reach**2))  # meet the ball around it

    # In its own frame and stretched it is the unit ball: |start + t * step| = 1.
    start, step = (origin - center) @ axes / half, rays[near] @ axes / half  # (3,), (near, 3)
    a, b, c = (step**2).sum(axis=1), step @ start, start @ start - 1
    under_root = b**2 - a * c
    with np.errstate(invalid="ignore"):
        t = (-b - np.sqrt(under_root)) / a  # the first of its two solutions
    distance[near] = np.where(t >= 0, t, np.inf)  # NaN: it passes by; below 0: from inside
    return distance


class RayCastCamera:
    """A fixed pinhole camera that casts rays at a MuJoCo model's visible geoms and sphere sites.

    MuJoCo's own rays pass through sites, yet goals are often drawn as sphere sites (Meta-World's
    are), so those are intersected here. Visible is what MuJoCo's renderer shows by default: groups
    0 to 2, alpha above 0. A body that never moves and is as wide as the workspace, or has a plane,
    is scenery: what stands on a floor needs a body of its own.

    Args:
        model: its camera is moved, and invisible geoms are put into a group that rays pass through.
        pixels: height and width of the square image.
        box: ((x, y, z) low, (x, y, z) high) of the workspace, world frame, metres.
        camera: the name of a camera of the model that is attached to the world.
        position: where it is moved, world frame, metres; None leaves it where it is.
        arm: names of bodies whose exact shape does not matter, as it takes most of the time: in
            clouds, though not in `depth` and `render`, each geom is the ellipsoid in its box.

    Raises:
        ValueError: the camera moves with a body, or does not see the workspace.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        pixels: int,
        box: tuple[Sequence[float], Sequence[float]],
        camera: str,
        position: Sequence[float] | None = None,
        arm: Sequence[str] = (),
    ):
        self.model = model
        self.pixels = pixels
        self.low, self.high = np.array(box, dtype=np.float64)

        # Where the camera is and what it looks at.
        index = model.camera(camera).id
        follows = model.cam_mode[index] != mujoco.mjtCamLight.mjCAMLIGHT_FIXED
        if model.cam_bodyid[index] != 0 or follows:
            raise ValueError(f"camera {camera!r} moves with a body; a fixed one is needed")
        if position is not None:
            model.cam_pos[index] = position  # in the model: MuJoCo's renderer would see the same
        self.origin = model.cam_pos[index].copy()
        self.tan = np.tan(np.deg2rad(model.cam_fovy[index]) / 2)  # half the image, a metre away
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.cam_quat[index])
        self.rotation = rotation.reshape(3, 3)  # columns: right, up, backward

        # What it sees. MuJoCo's rays hit some transparent geoms that its renderer leaves out.
        self.colors = geom_colors(model)  # (geoms, 4)
        model.geom_group[self.colors[:, 3] == 0] = HIDDEN_GROUP
        self.sites = np.flatnonzero(
            (model.site_type == mujoco.mjtGeom.mjGEOM_SPHERE)
            & VISIBLE[model.site_group]
            & (model.site_rgba[:, 3] > 0)
            & (model.site_size[:, 0] > 0)
        )

        # What of it becomes points: all but floor, table and walls.
        self.scenery, self.top = self.find_scenery()  # (geoms,) bool, and its height
        of_arm = np.isin(model.geom_bodyid, [model.body(name).id for name in arm])
        self.arm = np.flatnonzero(of_arm & VISIBLE[model.geom_group])
        self.things = ~self.scenery & ~of_arm & VISIBLE[model.geom_group]  # (geoms,) bool
        fixed = (model.body_weldid == 0) & (model.body_mocapid[model.body_rootid] < 0)
        self.still = self.things & fixed[model.geom_bodyid]  # in an episode; a mocap body is moved
        self.still_at, self.met_still = None, None

        # The rays that meet the workspace: they enter each slab of it before they leave any. And
        # four for each pixel.
        rays = self.rays(pixels)  # (pixels**2, 3)
        with np.errstate(divide="ignore"):
            first, second = (self.low - self.origin) / rays, (self.high - self.origin) / rays
        enter = np.minimum(first, second).max(axis=1)  # (pixels**2,) metres
        leave = np.maximum(first, second).min(axis=1)
        meets = leave > np.maximum(enter, 0)
        if not meets.any():
            raise ValueError(f"camera {camera!r} does not see the workspace: move one of them")
        self.in_workspace = meets.reshape(pixels, pixels)
        self.workspace_rays = rays[meets]  # (R, 3)
        self.cutoff = leave[meets].max()
        fine = self.rays(2 * pixels).reshape(pixels, 2, pixels, 2, 3)
        self.fine_rays = fine.swapaxes(1, 2).reshape(pixels, pixels, 4, 3)

    def find_scenery(self) -> tuple[np.ndarray, float]:
        """Returns (geoms,) bool: of a body that never moves and is as wide as the workspace.

        And how high they reach, world frame, metres.
        """
        model = self.model
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)

        # From boxes in the frames of the geoms to boxes in the world frame.
        rotation = data.geom_xmat.reshape(-1, 3, 3)
        boxes = model.geom_aabb[..., None].copy()
        middle, half = boxes[:, :3], boxes[:, 3:]  # (geoms, 3, 1) each
        endless = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        middle[endless], half[endless, :, 0] = 0, (FAR, FAR, 0)
        middle, half = (rotation @ middle)[..., 0], (np.abs(rotation) @ half)[..., 0]  # (geoms, 3)
        low, high = data.geom_xpos + middle - half, data.geom_xpos + middle + half

        scenery = np.zeros(model.ngeom, dtype=bool)
        for body in np.flatnonzero(model.body_weldid == 0):
            geoms = (model.geom_bodyid == body) & VISIBLE[model.geom_group]
            if geoms.any():
                width = high[geoms, 0].max() - low[geoms, 0].min()
                wide = width >= self.high[0] - self.low[0]
                scenery[geoms] = wide or endless[geoms].any()
        return scenery, high[scenery, 2].max(initial=-np.inf)

    def rays(self, pixels: int) -> np.ndarray:
        """Returns unit directions (pixels**2, 3), world frame, row by row from the top."""
        across = self.tan * ((np.arange(pixels) + 0.5) / pixels * 2 - 1)
        x, y = np.meshgrid(across, -across)
        rays = np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3) @ self.rotation.T
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def cast(
        self,
        data: mujoco.MjData,
        rays: np.ndarray,
        cutoff: float = FAR,
        geoms: np.ndarray | None = None,
        sites: Sequence[int] | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Casts rays from the camera.

        Args:
            data: the state of the simulation.
            rays: unit directions (R, 3), world frame.
            cutoff: geoms farther away than this are not met, metres.
            geoms: (geoms,) bool, those to cast at as far as they are visible; None: all.
            sites: those to cast at; None: all visible sphere sites.

        Returns:
            The distances (R,) in metres, inf where nothing is hit, and what is hit (R,): the index
            of a geom, -1 for nothing, or -2 - index of a site.
        """
        distance, hit = np.full(len(rays), np.inf), np.full(len(rays), -1, dtype=np.int32)

        groups, near = self.model.geom_group.copy(), np.arange(len(rays))
        if geoms is not None:
            self.model.geom_group[~geoms] = HIDDEN_GROUP
            near = self.near(data, rays, np.flatnonzero(geoms))
        t, what = np.empty(len(near)), np.empty(len(near), dtype=np.int32)
        target = (VISIBLE.astype(np.uint8), 1, -1)  # these groups, static geoms too, of every body
        mujoco.mj_multiRay(
            self.model, data, self.origin, rays[near].ravel(), *target, what, t, len(near), cutoff
        )
        self.model.geom_group[:] = groups
        distance[near[t >= 0]], hit[near[t >= 0]] = t[t >= 0], what[t >= 0]

        for site in self.sites if sites is None else sites:
            ball = data.site_xpos[site], np.eye(3), np.repeat(self.model.site_size[site, 0], 3)
            t = meet_ellipsoid(self.origin, rays, *ball)
            closer = t < distance
            distance[closer] = t[closer]
            hit[closer] = -2 - site

        return distance, hit

    def near(self, data: mujoco.MjData, rays: np.ndarray, geoms: np.ndarray) -> np.ndarray:
        """Returns which of the rays (R, 3) meet a ball around any of these geoms: indices."""
        to, radius = data.geom_xpos[geoms] - self.origin, self.model.geom_rbound[geoms]
        radius[self.model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_PLANE] = np.inf
        return np.flatnonzero(((rays @ to.T) ** 2 >= (to**2).sum(axis=1) - radius**2).any(axis=1))

    def cast_at_arm(self, data: mujoco.MjData, rays: np.ndarray) -> np.ndarray:
        """Returns the distances (R,) in metres to the arm's ellipsoids, inf where none is met."""
        distance = np.full(len(rays), np.inf)
        for geom in self.arm:
            axes, box = data.geom_xmat[geom].reshape(3, 3), self.model.geom_aabb[geom]
            center = data.geom_xpos[geom] + axes @ box[:3]
            t = meet_ellipsoid(self.origin, rays, center, axes, box[3:])
            np.minimum(distance, t, out=distance)
        return distance

    def points(self, data: mujoco.MjData) -> np.ndarray:
        """Returns what is seen of objects and sites in the workspace: (M, 3) float32, world frame.

        A ray a pixel is cast, and four where it meets a body or site that few others meet, or goes
        by it. The scenery and the arm give no points, but hide what is behind them.
        """
        targets = self.targets(data)
        rays = self.workspace_rays  # (R, 3)
        distance, hit = self.cast_at_things(data, *targets)
        there = self.inside(rays, distance)  # (R,) bool

        # The pixels of what few rays meet, and those beside them.
        body = np.where(hit < 0, hit, self.model.geom_bodyid[hit])[there]  # or site, below 0
        _, which, times = np.unique(body, return_inverse=True, return_counts=True)
        small = np.zeros(self.in_workspace.shape, dtype=bool)  # (pixels, pixels)
        small[self.in_workspace] = there
        small[small] = times[which] < FEW_RAYS
        small = binary_dilation(small)
        there &= ~small[self.in_workspace]

        more = self.fine_rays[small].reshape(-1, 3)
        rays = np.concatenate([rays[there], more])
        distance = np.concatenate([distance[there], self.cast(data, more, *targets)[0]])
        rays, distance = self.unhidden(data, rays, distance)
        seen = distance <= self.cast_at_arm(data, rays)
        return (self.origin + distance[seen, None] * rays[seen]).astype(np.float32)

    def cast_at_things(
        self, data: mujoco.MjData, cutoff: float, things: np.ndarray, sites: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """`cast` of the workspace's rays; what stands still is met once, until it is moved."""
        rays, at = self.workspace_rays, (data.geom_xpos[self.still], data.geom_xmat[self.still])
        if self.still_at is None or not all(map(np.array_equal, self.still_at, at)):
            self.still_at, self.met_still = at, self.cast(data, rays, cutoff, self.still, ())
        distance, hit = self.cast(data, rays, cutoff, things & ~self.still, sites)
        still, what = self.met_still
        return np.minimum(still, distance), np.where(still <= distance, what, hit)

    def arm_points(self, data: mujoco.MjData) -> np.ndarray:
        """Returns what is seen of the arm in the workspace: (M, 3) float32, on its ellipsoids."""
        rays = self.workspace_rays
        rays, distance = self.unhidden(data, rays, self.cast_at_arm(data, rays))
        seen = distance <= self.cast(data, rays, *self.targets(data))[0]
        return (self.origin + distance[seen, None] * rays[seen]).astype(np.float32)

    def targets(self, data: mujoco.MjData) -> tuple[float, np.ndarray, np.ndarray]:
        """What `cast` looks for: how far, (geoms,) bool and the sites of what becomes points."""
        # A site outside the workspace hides nothing: it marks a place, there is no body.
        center, radius = data.site_xpos[self.sites], self.model.site_size[self.sites, :1]
        outside = (center - radius >= self.high) | (center + radius <= self.low)
        return self.cutoff, self.things, self.sites[~outside.any(axis=1)]

    def inside(self, rays: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """Which rays (R, 3) are in the workspace after `distance` (R,) metres, inf allowed."""
        points = self.origin + np.minimum(distance, FAR)[:, None] * rays
        return ((points >= self.low) & (points <= self.high)).all(axis=1)

    def unhidden(
        self, data: mujoco.MjData, rays: np.ndarray, distance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Those rays (R, 3), and their `distance` (R,), that end before any scenery, in the box."""
        there = self.inside(rays, distance)
        rays, distance = rays[there], distance[there]
        height = self.origin[2] + distance * rays[:, 2]  # where they end
        near = np.minimum(height, self.origin[2]) <= self.top  # the others pass above all of it
        barrier = np.full(len(rays), np.inf)
        barrier[near], _ = self.cast(data, rays[near], self.cutoff, self.scenery, sites=())
        return rays[distance <= barrier], distance[distance <= barrier]

    def depth(self, data: mujoco.MjData) -> np.ndarray:
        """Returns metres along the viewing direction (pixels, pixels), inf where nothing is hit."""
        rays = self.rays(self.pixels)
        distance, _ = self.cast(data, rays)
        return (distance * (rays @ -self.rotation[:, 2])).reshape(self.pixels, self.pixels)

    def render(self, data: mujoco.MjData, pixels: int) -> np.ndarray:
        """Returns a picture (pixels, pixels, 3) uint8, shaded by the slope of the surfaces."""
        rays = self.rays(pixels)
        distance, hit = self.cast(data, rays)
        seen = np.isfinite(distance)

        # Counted from the end, -1 is the sky and -2 - i the site i.
        colors = np.concatenate([self.colors[:, :3], self.model.site_rgba[::-1, :3], [SKY]])
        color = colors[hit].reshape(pixels, pixels, 3)

        # The surface at a pixel is spanned by the ways to its neighbors.
        points = rays * np.where(seen, distance, 10.0)[:, None]
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


# ---- Environment ---------------------------------------------------------------------------------

CAMERA = "corner2"
CAMERA_POSITION = (0.6, 0.295, 0.8)  # world frame, metres; the orientation stays Meta-World's
CAMERA_PIXELS = 84  # twice as many where something small is
ARM = tuple(f"right_l{i}" for i in range(7))  # the seven links; hand and fingers are no part of it
RENDER_PIXELS = 240
WORKSPACE = ((-0.55, 0.3, -0.05), (0.6, 1.0, 0.48))  # the table and its holes, below the upper arm
NUM_POINTS = 512
NUM_THINGS = 384  # of them at most are of objects, markers and the gripper, the rest of the arm


class MetaWorldPointCloudEnv(gymnasium.Env):
    """A Meta-World task as a point cloud; also `gymnasium.make("DAMI/MetaWorld-v0", task="reach")`.

    Observation: "point_cloud" (N, 3) float32 and "agent_pos" (9,) float32, the positions of the end
    effector, the right and the left finger; world frame, metres. In a cloud come first farthest
    points of objects, goal marker and gripper, at most 384; those of the arm fill up the rest.

    Action (4,) in [-1, 1]: dx, dy, dz in centimetres, gripper (1 closes).

    Episodes are truncated at 200 steps and never terminate. Each step tells info["success"], and an
    episode succeeds if any of its steps does. `reset(seed=...)` draws objects and goals from that
    seed alone: the same seed gives the same episode.
    """

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 80}

    def __init__(self, task: str, num_points: int = NUM_POINTS, render_mode: str | None = None):
        self.task = check_task(task)
        self.num_points = num_points
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is {render_mode!r}; it can be None or 'rgb_array'")
        self.render_mode = render_mode

        self.simulator = env_dict.ALL_V3_ENVIRONMENTS[f"{task}-v3"]()
        self.simulator._set_task_called = True
        self.simulator._freeze_rand_vec = False  # draw objects and goals at each reset ...
        self.simulator.seeded_rand_vec = True  # ... from a generator of its own, not NumPy's global
        self.simulator._partially_observable = False  # the expert needs the goal
        del self.simulator.sawyer_observation_space  # cached with the goal hidden: clips it to zero
        self.expert = ENV_POLICY_MAP[f"{task}-v3"]()

        self.camera = RayCastCamera(
            self.simulator.model, CAMERA_PIXELS, WORKSPACE, CAMERA, CAMERA_POSITION, ARM
        )
        self.observation_space = gymnasium.spaces.Dict(
            {
                "point_cloud": gymnasium.spaces.Box(-np.inf, np.inf, (num_points, 3), np.float32),
                "agent_pos": gymnasium.spaces.Box(-np.inf, np.inf, (9,), np.float32),
            }
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Begins an episode; without a seed one is drawn. Returns (observation, info)."""
        super().reset(seed=seed)
        self.begin(int(self.np_random.integers(2**31)) if seed is None else seed)
        return self.observe(), {"success": False}

    def begin(self, seed: int) -> None:
        """Begins the episode of this seed without casting rays."""
        self.simulator.seed(seed)
        self.raw, _ = self.simulator.reset()
        # Without this the markers are still where the last episode had them.
        mujoco.mj_forward(self.simulator.model, self.simulator.data)
        self.steps = 0

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        """Takes one step: `advance`, then `observe`."""
        reward, truncated, info = self.advance(action)
        return self.observe(), reward, False, truncated, info

    def advance(self, action: np.ndarray) -> tuple[float, bool, dict]:
        """Takes one step without casting rays. Returns (reward, truncated, info)."""
        action = np.clip(np.asarray(action, dtype=np.float32), -1, 1)
        if action.shape != (4,) or not np.isfinite(action).all():
            raise ValueError(f"an action is four finite numbers, not {action}")

        self.raw, reward, _, _, info = self.simulator.step(action)
        self.steps += 1
        return float(reward), self.steps >= EPISODE_STEPS, {"success": bool(info["success"])}

    def observe(self) -> dict[str, np.ndarray]:
        """Casts the rays and returns the observation of the present moment."""
        data = self.simulator.data
        fingers = [data.site("rightEndEffector").xpos, data.site("leftEndEffector").xpos]
        return {
            "point_cloud": self.cloud(),
            "agent_pos": np.concatenate([data.body("hand").xpos, *fingers]).astype(np.float32),
        }

    def cloud(self) -> np.ndarray:
        """Returns N of the points that the camera sees, (N, 3) float32, the arm's last."""
        N, data = self.num_points, self.simulator.data
        cloud = self.camera.points(data)
        cloud = (
            farthest_point_sample(cloud, min(N, NUM_THINGS, len(cloud))) if len(cloud) else cloud
        )
        if len(cloud) < N and len(arm := self.camera.arm_points(data)):
            arm = farthest_point_sample(arm, min(N - len(cloud), len(arm)))
            cloud = np.concatenate([cloud, arm])
        return np.resize(cloud, (N, 3))  # repeated from its beginning

    def expert_action(self) -> np.ndarray:
        """Returns the scripted expert's action (4,) float32 in [-1, 1] for the present moment."""
        return np.clip(self.expert.get_action(self.raw), -1, 1).astype(np.float32)

    def render(self) -> np.ndarray | None:
        """Returns a picture (240, 240, 3) uint8 from the camera of the point clouds."""
        if self.render_mode != "rgb_array":
            return None
        return self.camera.render(self.simulator.data, RENDER_PIXELS)

    def close(self) -> None:
        self.simulator.close()


if "DAMI/MetaWorld-v0" not in gymnasium.registry:
    gymnasium.register("DAMI/MetaWorld-v0", entry_point=f"{__name__}:MetaWorldPointCloudEnv")


# ---- Collecting demonstrations of the scripted experts -------------------------------------------

ATTEMPTS_PER_EPISODE = 20
RECIPE = {
    "camera": [CAMERA, list(CAMERA_POSITION), CAMERA_PIXELS, "twice where something small is"],
    "arm": ["ellipsoids", "after at most", NUM_THINGS],
    "workspace": [list(corner) for corner in WORKSPACE],
    "num_points": NUM_POINTS,
    "sampling": "farthest points",
    "positions_in_state": 3,  # hand and fingers; actions begin with a displacement of the hand
}


def collect(
    tasks: Sequence[str],
    folder: str | Path,
    episodes: int = 10,
    seed: int = 0,
    workers: int | None = None,
) -> dict[str, Path]:
    """Collects `episodes` successful episodes of each task, a process a task at a time.

    Files in `folder` that already hold enough episodes of this recipe and seed are kept; those with
    fewer are made again. Raises ValueError for one that was recorded otherwise: it is never
    overwritten.

    Returns:
        task -> file.
    """
    at_least(1, episodes=episodes)
    episode_seed(seed, 0)  # refuses a seed out of range
    paths = {check_task(task): Path(folder) / f"{task}.npz" for task in tasks}
    Path(folder).mkdir(parents=True, exist_ok=True)

    recipe = RECIPE | {"seed": seed}
    missing = []
    for task, path in paths.items():
        if not path.exists():
            missing.append(task)
            continue
        old = load_demonstrations(path)
        if other := made_otherwise(old, recipe | {"task": task}):
            what = f"{path} was recorded with another {other}"
            raise ValueError(f"{what}: move it or use another --data")
        if len(old) < episodes:
            missing.append(task)

    if missing and not os.access(folder, os.W_OK):
        raise ValueError(f"{folder} cannot be written to: use another --data")
    remove_temporaries(Path(folder))
    jobs = [(task, paths[task], episodes, seed) for task in missing]
    run_jobs(collect_task, jobs, workers, len(missing) * episodes, "collecting")
    return paths


def collect_task(task: str, path: Path, episodes: int, seed: int) -> None:
    """Records `episodes` successful episodes of one task into a file."""
    start = time.perf_counter()
    env = MetaWorldPointCloudEnv(task, NUM_POINTS)

    frames = {"points": [], "state": [], "action": []}
    ends, seeds, successes, attempt = [], [], [], 0
    while len(seeds) < episodes:
        if attempt >= ATTEMPTS_PER_EPISODE * episodes:
            raise ValueError(
                f"{task}: the expert succeeded in {len(seeds)} of {attempt} episodes; "
                "try another --seed"
            )
        drawn = demonstration_seed(task, seed, attempt)
        episode = record_episode(env, drawn)
        if worker.stop.is_set():
            return

        attempt += 1
        if episode is not None:
            recorded, success = episode
            for field, values in recorded.items():
                frames[field].extend(values)
            ends.append(len(frames["action"]))
            seeds.append(drawn)
            successes.append(success)
            worker.finished.put((task, 1))

    packages = ("metaworld", "mujoco", "fpsample", "numpy")
    meta = RECIPE | {
        "made_by": "simulator.collect",
        "seed": seed,
        "episode_seeds": seeds,
        "success_frames": successes,
        "expert_success_rate": len(seeds) / attempt,
        "seconds": round(time.perf_counter() - start, 1),
        "versions": {package: version(package) for package in packages},
    }
    arrays = {field: np.stack(values) for field, values in frames.items()}
    arrays["episode_ends"] = np.array(ends, dtype=np.int64)
    save_demonstrations(path, Demonstrations(task, INSTRUCTIONS[task], **arrays, meta=meta))


def record_episode(env: MetaWorldPointCloudEnv, seed: int) -> tuple[dict, int] | None:
    """Lets the expert act for one episode.

    Returns its points, state and action, a list of frames each, and the frame of its first success;
    None if it had none, or `worker.stop` was set.
    """
    env.begin(seed)
    frames = {"points": [], "state": [], "action": []}
    success = None

    for frame in range(EPISODE_STEPS):
        if worker.stop.is_set():
            return None
        observation, action = env.observe(), env.expert_action()
        frames["points"].append(observation["point_cloud"].astype(np.float16))
        frames["state"].append(observation["agent_pos"])
        frames["action"].append(action)

        _, _, info = env.advance(action)
        if info["success"] and success is None:
            success = frame

    return None if success is None else (frames, success)


# ---- Command line --------------------------------------------------------------------------------


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Collect expert demonstrations of Meta-World.")
    parser.add_argument("--suite", default="ml10", help="all tasks of ml10 or ml45 (ml10)")
    parser.add_argument("--task", help="only this task")
    parser.add_argument("--data", default="data", help="folder of the files (data)")
    parser.add_argument("--episodes", type=int, default=10, help="successful ones a task (10)")
    parser.add_argument("--seed", type=int, default=0, help="of objects and goals, 0 to 999 (0)")
    parser.add_argument("--workers", type=int, help="processes (one a core)")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    args = parse(argv)
    base, novel = suite_tasks(args.suite)
    tasks = [check_task(args.task)] if args.task else base + novel

    paths = collect(tasks, args.data, args.episodes, args.seed, args.workers)

    print(f"{'task':28}{'episodes':>9}{'expert':>8}{'frames':>8}{'seconds':>9}{'MB':>6}")
    for task, path in paths.items():
        demonstrations = load_demonstrations(path)
        meta, frames = demonstrations.meta, len(demonstrations.points)
        print(
            f"{task:28}{len(demonstrations):9}{meta['expert_success_rate']:8.0%}{frames:8}"
            f"{meta['seconds']:9.1f}{path.stat().st_size / 1e6:6.1f}"
        )


if __name__ == "__main__":
    command_line(main)
