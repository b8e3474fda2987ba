"""Point clouds of any MuJoCo model by casting rays: no OpenGL, no GPU.

    camera = RayCastCamera(model, pixels=84, box=((-1, -1, 0), (1, 1, 1)), camera="corner")
    points = camera.points(data)  # (M, 3) float32, world frame, metres

The camera casts rays (`mujoco.mj_multiRay`) instead of rasterizing. This file imports nothing of
the project, so that it can be copied alone.

Letters: R rays, M points that the camera sees.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from scipy.ndimage import binary_dilation

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
    is background: what stands on a floor needs a body of its own.

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

        # What of it becomes points: all but the background (floor, table, walls) and the arm.
        visible = VISIBLE[model.geom_group]  # (geoms,) bool, as are all masks of geoms
        self.background_geoms, self.background_top = self.find_background()
        of_arm = np.isin(model.geom_bodyid, [model.body(name).id for name in arm])
        self.arm_geoms = np.flatnonzero(of_arm & visible)  # indices
        self.object_geoms = ~self.background_geoms & ~of_arm & visible

        # What does not move during an episode; a mocap body is moved.
        static_bodies = (model.body_weldid == 0) & (model.body_mocapid[model.body_rootid] < 0)
        self.static_geoms = self.object_geoms & static_bodies[model.geom_bodyid]
        self.static_poses = None  # where they were when rays were last cast at them
        self.static_hits = None  # the distances and geoms that `cast` then returned

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

    def find_background(self) -> tuple[np.ndarray, float]:
        """Finds the bodies that never move and are as wide as the workspace, or have a plane.

        Returns their geoms as a mask (geoms,) bool, and how high they reach, world frame, metres.
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

        background = np.zeros(model.ngeom, dtype=bool)
        for body in np.flatnonzero(model.body_weldid == 0):
            geoms = (model.geom_bodyid == body) & VISIBLE[model.geom_group]
            if geoms.any():
                width = high[geoms, 0].max() - low[geoms, 0].min()
                wide = width >= self.high[0] - self.low[0]
                background[geoms] = wide or endless[geoms].any()
        return background, high[background, 2].max(initial=-np.inf)

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
        for geom in self.arm_geoms:
            axes, box = data.geom_xmat[geom].reshape(3, 3), self.model.geom_aabb[geom]
            center = data.geom_xpos[geom] + axes @ box[:3]
            t = meet_ellipsoid(self.origin, rays, center, axes, box[3:])
            np.minimum(distance, t, out=distance)
        return distance

    def points(self, data: mujoco.MjData) -> np.ndarray:
        """Returns what is seen of objects and sites in the workspace: (M, 3) float32, world frame.

        A ray a pixel is cast, and four where it meets a body or site that few others meet, or goes
        by it. The background and the arm give no points, but hide what is behind them.
        """
        targets = self.targets(data)
        rays = self.workspace_rays  # (R, 3)
        distance, hit = self.cast_at_objects(data, *targets)
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

    def cast_at_objects(
        self, data: mujoco.MjData, cutoff: float, object_geoms: np.ndarray, sites: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Casts the workspace's rays, at static geoms only if they moved; returns as `cast`."""
        rays = self.workspace_rays
        poses = np.concatenate(
            [data.geom_xpos[self.static_geoms], data.geom_xmat[self.static_geoms]], axis=1
        )  # (static geoms, 3 + 9)
        if self.static_poses is None or not np.array_equal(self.static_poses, poses):
            self.static_poses = poses
            self.static_hits = self.cast(data, rays, cutoff, self.static_geoms, sites=())
        distance, hit = self.cast(data, rays, cutoff, object_geoms & ~self.static_geoms, sites)
        static_distance, static_hit = self.static_hits
        nearest = np.where(static_distance <= distance, static_hit, hit)
        return np.minimum(static_distance, distance), nearest

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
        return self.cutoff, self.object_geoms, self.sites[~outside.any(axis=1)]

    def inside(self, rays: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """Which rays (R, 3) are in the workspace after `distance` (R,) metres, inf allowed."""
        points = self.origin + np.minimum(distance, FAR)[:, None] * rays
        return ((points >= self.low) & (points <= self.high)).all(axis=1)

    def unhidden(
        self, data: mujoco.MjData, rays: np.ndarray, distance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns those rays (R, 3) and their distances (R,) that no background cuts short.

        Rays that end outside the workspace are dropped, too.
        """
        there = self.inside(rays, distance)
        rays, distance = rays[there], distance[there]
        height = self.origin[2] + distance * rays[:, 2]  # where they end
        # The others pass above all of the background.
        near = np.minimum(height, self.origin[2]) <= self.background_top
        barrier = np.full(len(rays), np.inf)
        barrier[near], _ = self.cast(data, rays[near], self.cutoff, self.background_geoms, sites=())
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
