"""Point clouds of any MuJoCo model by casting rays: no OpenGL, no GPU.

    camera = RayCastCamera(model, position=(2, -2, 2), lookat=(0, 0, 0.5))
    points = camera.points(data)  # (M, 3) float32, world frame, metres

A ray is cast through each pixel (`mujoco.mj_multiRay`) instead of rasterizing. This file imports
nothing of the project, so that it can be copied alone: it needs NumPy and MuJoCo 3.2 or later.

Letters: H and W height and width of an image in pixels, R rays, M points that the camera sees.
"""

import copy
from collections.abc import Sequence

import mujoco
import numpy as np

SKY = (0.75, 0.85, 0.95)
LIGHT = (0.4, -0.5, 0.77)  # direction towards the light, unit length within 1 %
FAR = 1e9  # metres

# What later releases of MuJoCo do differently: rays may return the normals of surfaces, and the
# field that says which cameras are orthographic has another name.
NO_NORMALS = (None,) if "normal" in mujoco.mj_multiRay.__doc__ else ()
PROJECTION = "cam_projection" if hasattr(mujoco.MjModel, "cam_projection") else "cam_orthographic"


def drawn_colors(model: mujoco.MjModel, kind: str, groups: Sequence[int]) -> np.ndarray:
    """Returns the RGBA (n, 4) in [0, 1] in which MuJoCo draws the n objects of a kind.

    The color of a texture is the mean of every 16th texel. What is not drawn has alpha 0.

    Args:
        kind: "geom", "site", "flex" or "skin".
        groups: those that are drawn, 0 to 5.
    """
    rgba = getattr(model, f"{kind}_rgba")  # (n, 4)
    material = getattr(model, f"{kind}_matid")  # (n,), -1 for none
    group = getattr(model, f"{kind}_group").clip(0, mujoco.mjNGROUP - 1)  # (n,)

    textures = np.ones((model.nmat + 1, 3))  # of each material, and of none, whose index is -1
    for index in range(model.nmat):
        texture = model.mat_texid[index, mujoco.mjtTextureRole.mjTEXROLE_RGB]
        if texture >= 0:
            start, channels = model.tex_adr[texture], model.tex_nchannel[texture]
            size = model.tex_height[texture] * model.tex_width[texture] * channels
            texels = model.tex_data[start : start + size].reshape(-1, channels)
            textures[index] = texels[::16, :3].mean(axis=0) / 255

    colors = rgba.astype(np.float64)
    # An object that names no color has this one; if it has a material, that is drawn instead.
    undefined = (rgba == (0.5, 0.5, 0.5, 1)).all(axis=1) & (material >= 0)
    colors[undefined] = model.mat_rgba[material[undefined]]
    colors[:, :3] *= textures[material]
    colors[~np.isin(group, groups), 3] = 0
    return colors


def first_hits(
    model: mujoco.MjModel, data: mujoco.MjData, origin: np.ndarray, rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Casts rays, unit directions (R, 3), from `origin` (3,) at all geoms that are not transparent.

    Returns the distances (R,) in metres, inf where nothing is hit, and the geoms (R,), -1 there.
    """
    distance, geom = np.empty(len(rays)), np.empty(len(rays), dtype=np.int32)
    every_geom = (None, True, -1)  # of each group, static ones too, of each body
    results = (geom, distance, *NO_NORMALS)
    mujoco.mj_multiRay(model, data, origin, rays.ravel(), *every_geom, *results, len(rays), FAR)
    distance[geom < 0] = np.inf
    return distance, geom


def look_at(position: Sequence[float], lookat: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pose of an upright camera, as `RayCastCamera.pose` does."""
    position = np.array(position, dtype=np.float64)
    backward = position - lookat
    if not backward.any():
        raise ValueError(f"a camera at {position} cannot look at that same point")
    right = np.cross((0, 0, 1), backward)
    if not right.any():  # it looks straight up or down
        right = np.array([1.0, 0.0, 0.0])
    axes = np.stack([right, np.cross(backward, right), backward], axis=1)
    return position, axes / np.linalg.norm(axes, axis=0)


def geoms_of(model: mujoco.MjModel, bodies: Sequence[str | int]) -> np.ndarray:
    """Returns which geoms belong to these bodies, given by name or index: (geoms,) bool."""
    return np.isin(model.geom_bodyid, [model.body(body).id for body in bodies])


class RayCastCamera:
    """A pinhole camera that casts rays at the geoms and sites of a MuJoCo model.

    It sees what MuJoCo's renderer draws by default: geoms of every type, and sites, of the groups 0
    to 2 and with alpha above 0. It does not see tendons; what is half transparent is opaque to it;
    and from within a geom it sees that geom's inside, which the renderer leaves out. The distance
    of what is seen equals `mujoco.mj_ray`'s.

    Args:
        model: it is copied, since casting needs a few changes. What changes in the model later,
            like sizes and colors, is not seen by this camera. Poses are read from the data.
        camera: the name or index of a camera of the model. It may be fixed, move with a body, or
            follow one.
        position, lookat: in place of `camera`, an upright one at a position that looks at another,
            world frame, metres. Its field of view is that of the model's free camera.
        height, width: of the image in pixels.
        box: ((x, y, z) low, (x, y, z) high), world frame, metres. Only points inside are returned.
        background: names or indices of bodies that hide what is behind them, but give no points; by
            default the world itself, to which floors belong.
        groups: of the geoms and sites that are seen, 0 to 5.
        sites: whether sites are seen. Goals are often drawn as sites.
        hidden_sites: names or indices of sites that are not.
        ellipsoids: names or indices of bodies whose exact shape does not matter: in clouds, though
            not in `depth` and `render`, their meshes are ellipsoids. Meshes take most of the time.

    Raises:
        KeyError, IndexError: the model has no such camera, body or site.
        ValueError: not exactly one of `camera` and `position` with `lookat` is given; the camera is
            orthographic, or has a lens of its own (`sensorsize`); the box is empty; or a flex or a
            skin would be drawn, which rays do not meet.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        camera: str | int | None = None,
        *,
        position: Sequence[float] | None = None,
        lookat: Sequence[float] | None = None,
        height: int = 84,
        width: int = 84,
        box: tuple[Sequence[float], Sequence[float]] = ((-np.inf,) * 3, (np.inf,) * 3),
        background: Sequence[str | int] = ("world",),
        groups: Sequence[int] = (0, 1, 2),
        sites: bool = True,
        hidden_sites: Sequence[str | int] = (),
        ellipsoids: Sequence[str | int] = (),
    ):
        self.height, self.width = height, width
        self.low, self.high = np.array(box, dtype=np.float64)  # (3,) each
        if not (self.low < self.high).all():
            raise ValueError(f"the box is empty: its low corner is {box[0]}, its high one {box[1]}")

        # Where the camera is and how wide it sees.
        given = [x is not None for x in (camera, position, lookat)]
        if given not in ([True, False, False], [False, True, True]):
            raise ValueError("give either a camera of the model, or a position and a lookat")
        if camera is None:
            self.camera, self.free_pose = None, look_at(position, lookat)
            fovy, orthographic = model.vis.global_.fovy, model.vis.global_.orthographic
        else:
            self.camera = model.camera(camera).id
            fovy = model.cam_fovy[self.camera]
            orthographic = getattr(model, PROJECTION)[self.camera]
            if model.cam_sensorsize[self.camera].any():
                raise ValueError(f"camera {camera!r} has a lens of its own, which is not supported")
        if orthographic:
            raise ValueError("an orthographic camera is not supported")
        self.slope = np.tan(np.deg2rad(fovy) / 2)  # of the rays at the image's upper edge
        self.rays = self.pixel_rays(height, width)

        # What it sees, and in which colors.
        for kind in ("flex", "skin"):
            if drawn_colors(model, kind, groups)[:, 3].any():
                raise ValueError(f"rays do not meet a {kind}: move it to a group that is not seen")
        geom_colors = drawn_colors(model, "geom", groups)
        site_colors = drawn_colors(model, "site", groups)
        self.colors = np.concatenate([geom_colors[:, :3], site_colors[:, :3], [SKY]])

        # The model as rays are to see it. `mj_multiRay` skips a body whose bounding volume a ray
        # misses. But that volume is made for collisions, and lacks the geoms that take no part in
        # them. Without one, each ray is tested against each geom, as `mj_ray` does.
        self.view = copy.copy(model)
        self.view.body_bvhadr[:] = -1
        self.view.geom_rgba[:] = geom_colors
        self.view.geom_matid[:] = -1  # a ray goes through a geom of alpha 0 only without a material
        meshes = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
        self.types, self.cloud_types = model.geom_type.copy(), model.geom_type.copy()
        ellipsoid = mujoco.mjtGeom.mjGEOM_ELLIPSOID
        self.cloud_types[meshes & geoms_of(model, ellipsoids)] = ellipsoid

        # Rays do not meet sites, so that a second model has a geom for each one that is seen.
        seen_sites = (site_colors[:, 3] > 0) & sites  # (sites,) bool
        seen_sites[[model.site(site).id for site in hidden_sites]] = False
        self.sites = np.flatnonzero(seen_sites)
        spec = mujoco.MjSpec()
        for site in self.sites:
            spec.worldbody.add_geom(type=mujoco.mjtGeom(model.site_type[site]), size=(1, 1, 1))
        self.site_view = spec.compile()
        self.site_view.geom_size[:] = model.site_size[self.sites]
        self.site_view.body_bvhadr[:] = -1
        self.site_data = mujoco.MjData(self.site_view)

        # What gives no points: the background, and the sky, whose index is -1.
        background_geoms = geoms_of(model, background)
        self.background = np.concatenate([background_geoms, np.zeros(model.nsite, bool), [True]])

    def pixel_rays(self, height: int, width: int) -> np.ndarray:
        """Returns unit directions (H * W, 3) in the camera's frame: right, up, backward.

        They go through the middle of each pixel, row by row from the top.
        """
        right = self.slope * (2 * np.arange(width) + 1 - width) / height
        up = self.slope * (height - 1 - 2 * np.arange(height)) / height
        x, y = np.meshgrid(right, up)  # (H, W) each
        rays = np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def pose(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Returns the camera's position (3,) and axes (3, 3), world frame, metres.

        The axes are columns: right, up, backward. Raises ValueError for the data of a model with
        another number of geoms or sites, and where no poses were computed yet.
        """
        sizes = len(data.geom_xpos), len(data.site_xpos)
        if sizes != (self.view.ngeom, self.view.nsite):
            raise ValueError("the data is of another model than the camera")
        if not data.xmat[0].any():  # the world's, which never turns
            raise ValueError("the data has no poses yet: call mujoco.mj_forward(model, data) first")
        if self.camera is None:
            return self.free_pose
        return data.cam_xpos[self.camera], data.cam_xmat[self.camera].reshape(3, 3)

    def cast(
        self, data: mujoco.MjData, origin: np.ndarray, rays: np.ndarray, types: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Casts rays at geoms and sites.

        Args:
            data: the state of the simulation.
            origin: where the rays begin (3,), world frame, metres.
            rays: unit directions (R, 3), world frame.
            types: of the geoms (geoms,), `self.types` or, with ellipsoids, `self.cloud_types`.

        Returns:
            The distances (R,) in metres, inf where nothing is hit, and what is hit (R,): the index
            of a geom, the number of geoms plus the index of a site, or -1 for nothing.
        """
        self.view.geom_type[:] = types
        distance, hit = first_hits(self.view, data, origin, rays)

        self.site_data.geom_xpos[:] = data.site_xpos[self.sites]
        self.site_data.geom_xmat[:] = data.site_xmat[self.sites]
        site_distance, geom = first_hits(self.site_view, self.site_data, origin, rays)
        closer = site_distance < distance
        distance[closer] = site_distance[closer]
        hit[closer] = self.view.ngeom + self.sites[geom[closer]]
        return distance, hit

    def points(
        self, data: mujoco.MjData, *, color: bool = False, segmentation: bool = False
    ) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
        """Returns the points that the camera sees, (M, 3) float32, world frame, metres.

        Args:
            data: the state of the simulation, after `mj_forward`, or a step.
            color: whether red, green and blue in [0, 1] follow each position: (M, 6).
            segmentation: whether to return (points, hit), where hit (M,) int32 is the index of each
                point's geom, or the number of geoms plus the index of its site.

        Raises:
            ValueError: the data is of a model with another number of geoms or sites, or has no
                poses yet.
        """
        origin, axes = self.pose(data)
        rays = self.rays @ axes.T  # (H * W, 3), from the camera's frame to the world's

        # A ray that meets the box enters each of its three slabs before it leaves any.
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = (self.low - origin) / rays, (self.high - origin) / rays
        enter, leave = np.minimum(first, second), np.maximum(first, second)  # (H * W, 3) metres
        in_face = np.isnan(enter)  # 0 / 0: the ray runs in a face, and is always in that slab
        enter[in_face], leave[in_face] = -np.inf, np.inf
        rays = rays[leave.min(axis=1) > np.maximum(enter.max(axis=1), 0)]  # (R, 3)

        distance, hit = self.cast(data, origin, rays, self.cloud_types)  # (R,) each
        seen = ~self.background[hit]
        points, hit = origin + distance[seen, None] * rays[seen], hit[seen]
        inside = ((points >= self.low) & (points <= self.high)).all(axis=1)
        points, hit = points[inside], hit[inside]  # (M, 3), (M,)

        if color:
            points = np.concatenate([points, self.colors[hit]], axis=1)  # (M, 6)
        points = points.astype(np.float32)
        return (points, hit) if segmentation else points

    def depth(self, data: mujoco.MjData) -> np.ndarray:
        """Returns metres along the viewing direction (H, W) float64, inf where nothing is hit.

        All that the camera sees is in it: box and background do not apply. Raises ValueError as
        `points` does.
        """
        origin, axes = self.pose(data)
        distance, _ = self.cast(data, origin, self.rays @ axes.T, self.types)
        return (distance * -self.rays[:, 2]).reshape(self.height, self.width)

    def render(self, data: mujoco.MjData, height: int, width: int) -> np.ndarray:
        """Returns a picture (height, width, 3) uint8, shaded by the slope of the surfaces.

        Box and background do not apply. Raises ValueError as `points` does.
        """
        origin, axes = self.pose(data)
        rays = self.pixel_rays(height, width) @ axes.T
        distance, hit = self.cast(data, origin, rays, self.types)
        color = self.colors[hit].reshape(height, width, 3)
        seen = np.isfinite(distance).reshape(height, width)

        # The surface at a pixel is spanned by the ways to its neighbors.
        points = (rays * np.where(hit < 0, 10.0, distance)[:, None]).reshape(height, width, 3)
        right = np.diff(points, axis=1, append=2 * points[:, -1:] - points[:, -2:-1])
        up = -np.diff(points, axis=0, append=2 * points[-1:] - points[-2:-1])
        normal = np.cross(right, up)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True) + 1e-12

        shade = np.where(seen, 0.55 + 0.45 * (normal @ np.array(LIGHT)), 1.0)
        return (255 * np.clip(color * shade[..., None], 0, 1)).astype(np.uint8)
