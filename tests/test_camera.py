"""Tests of camera.py against `mj_ray`, analytic scenes, Meta-World and, where it runs, OpenGL."""

import copy
import subprocess
import sys
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest

import metaworld_env
from camera import RayCastCamera
from metaworld_env import MetaWorldPointCloudEnv

ROOT = Path(metaworld_env.__file__).resolve().parent


def scene(world, assets="", visual=""):
    """A model of what is in the world and in the assets, in XML, and its data."""
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><visual>{visual}</visual><asset>{assets}</asset>"
        f"<worldbody>{world}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def rays_of(camera, data):
    """Where the camera is, and its rays in the world frame."""
    origin, axes = camera.pose(data)
    return origin, camera.rays @ axes.T


# ---- Against mj_ray ------------------------------------------------------------------------------


def check_rays(camera, model, data, every=1):
    """Compares every so many rays with `mj_ray`'s. Returns how many hit a geom."""
    origin, rays = rays_of(camera, data)
    rays = rays[::every]
    groups, geom = np.uint8([1, 1, 1, 0, 0, 0]), np.empty(1, dtype=np.int32)
    expected, geoms = np.empty(len(rays)), np.empty(len(rays), dtype=int)
    for index, ray in enumerate(rays):
        expected[index] = mujoco.mj_ray(model, data, origin, ray, groups, 1, -1, geom)
        geoms[index] = geom[0]
    expected[geoms < 0] = np.inf

    distance, hit = camera.cast(data, origin, rays, camera.types)
    on_site = hit >= model.ngeom  # of which `mj_ray` knows nothing
    assert (distance[on_site] < expected[on_site]).all()
    np.testing.assert_array_equal(distance[~on_site], expected[~on_site])
    np.testing.assert_array_equal(hit[~on_site], geoms[~on_site])
    return (geoms >= 0).sum()


VISUAL_BOX = """
  <body pos="0 0 0.5">
    <geom type="box" size="0.5 0.4 0.3" contype="0" conaffinity="0"/>
    <geom type="sphere" size="0.05" pos="0.2 0 0" group="3"/>
  </body>
"""
PRIMITIVES = """
  <geom type="plane" size="1 1 1" pos="0 0 -1"/>
  <body pos="-1 0 0" euler="20 30 0"><geom type="sphere" size="0.4"/></body>
  <body pos="-0.5 0.7 0" euler="20 30 40"><geom type="capsule" size="0.2 0.3"/></body>
  <body pos="0 -0.5 0" euler="20 30 80"><geom type="ellipsoid" size="0.2 0.3 0.4"/></body>
  <body pos="0.5 0.6 0" euler="20 30 120"><geom type="cylinder" size="0.3 0.2"/></body>
  <body pos="1 0 0" euler="20 30 160"><geom type="box" size="0.2 0.3 0.4"/></body>
"""
HEIGHTS = " ".join(str(3 * index % 7) for index in range(25))
HILLS = f'<hfield name="hills" nrow="5" ncol="5" size="1 1 0.5 0.1" elevation="{HEIGHTS}"/>'
TETRAHEDRON = '<mesh name="tetrahedron" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>'
GROUPS = "".join(
    f'<geom type="sphere" size="0.3" pos="{group / 3} 0 {group / 9}" group="{group}"/>'
    for group in (-3, 0, 1, 2, 3, 4, 5, 7)
)
TRANSPARENT = """
  <geom type="box" size="1 1 0.1" pos="0 0 1" rgba="1 0 0 0"/>
  <geom type="box" size="0.9 0.9 0.1" pos="0 0 0.5" material="clear"/>
  <geom type="box" size="0.4 0.4 0.1" pos="0 0 -0.5" rgba="1 0 0 0.1"/>
"""
CLEAR = '<material name="clear" rgba="1 1 1 0"/>'


@pytest.mark.parametrize("position", [(2, -3, 2), (0.01, 0, 5), (-3, 0.1, 0.1)])
@pytest.mark.parametrize(
    "world, assets",
    [
        (VISUAL_BOX, ""),
        (PRIMITIVES, ""),
        ('<geom type="hfield" hfield="hills"/>', HILLS),
        ('<body><geom type="mesh" mesh="tetrahedron"/></body>', TETRAHEDRON),
        (GROUPS, ""),
        (TRANSPARENT, CLEAR),
    ],
    ids=["a visual box beside a small sphere", "types", "hills", "mesh", "groups", "transparent"],
)
def test_distances_and_geoms_are_those_of_mj_ray(world, assets, position):
    model, data = scene(world, assets)
    camera = RayCastCamera(model, position=position, lookat=(0, 0, 0.1), height=50, width=60)
    assert check_rays(camera, model, data) > 30


@pytest.mark.parametrize("name", ["ant", "humanoid", "half_cheetah", "pusher_v5"])
def test_models_of_gymnasium_are_seen_as_by_mj_ray(name):
    path = Path(gymnasium.__file__).parent / f"envs/mujoco/assets/{name}.xml"
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(200):
        data.ctrl[:] = rng.uniform(-1, 1, model.nu)
        mujoco.mj_step(model, data)
    middle = data.subtree_com[0]
    camera = RayCastCamera(model, position=middle + (1, -2, 1.5), lookat=middle)
    assert check_rays(camera, model, data, every=3) > 100
    for index in range(model.ncam):  # those that the model has move with a body
        assert check_rays(RayCastCamera(model, index), model, data, every=3) > 100


@pytest.mark.parametrize("task", list(metaworld_env.INSTRUCTIONS))
def test_every_task_is_seen_as_by_mj_ray_and_resets_to_a_cloud_inside_the_workspace(task):
    env = MetaWorldPointCloudEnv(task, num_points=128)
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation) and info == {"success": False}
    cloud = observation["point_cloud"]
    assert np.isfinite(cloud).all() and len(np.unique(cloud, axis=0)) > 60
    low, high = np.float32(metaworld_env.WORKSPACE)
    assert (cloud >= low).all() and (cloud <= high).all()

    every = 1 if task in ("hammer", "door-lock", "lever-pull") else 11
    model, data = env.sawyer_env.model, env.sawyer_env.data
    assert check_rays(env.camera, model, data, every) > 4000 / every
    for _ in range(60):
        action = env.expert_action()
        assert env.action_space.contains(action)
        env.advance(action)
    assert check_rays(env.camera, model, data, every) > 4000 / every


# ---- What is seen --------------------------------------------------------------------------------

# Cameras look down from a height of 2: fixed, on a post, on a body that moves, at a body.
BALLS = """
  <camera name="down" pos="0 0 2" fovy="60"/>
  <body pos="0 0 2"><camera name="on a post" fovy="60"/></body>
  <body name="cart" pos="1 0 2" euler="0 0 90">
    <joint name="rail" type="slide" axis="0 1 0"/>
    <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
    <camera name="on a cart" fovy="60"/>
  </body>
  <camera name="at the ball" pos="2 1 2" mode="targetbody" target="ball"/>
  <geom type="plane" size="5 5 1"/>
  <body name="ball" pos="0.4 0.3 0.5"><geom name="ball" size="0.3" rgba="1 0 0 1"/></body>
  <body><geom name="cube" type="box" size="0.2 0.2 0.2" pos="-0.5 -0.3 0.2"/></body>
  <body><geom name="under the floor" type="sphere" size="0.1" pos="0.4 -0.4 -0.3"/></body>
  <site type="sphere" size="0.3" pos="0 0 1" rgba="1 0 0 0"/>
  <site name="marker" type="sphere" size="0.1" pos="-0.4 0.4 0.6" rgba="0 1 0 1"/>
  <site type="sphere" size="0.3" pos="0 0 1" group="3"/>
"""
BALL, CUBE, MARKER = (0.4, 0.3, 0.5), (-0.5, -0.3, 0.2), (-0.4, 0.4, 0.6)


def on_surfaces(points):
    """Which points lie on the ball, the cube and the marker: three (M,) bool."""
    ball = np.abs(np.linalg.norm(points - BALL, axis=1) - 0.3) < 1e-5
    cube = np.abs(np.abs(points - CUBE).max(axis=1) - 0.2) < 1e-5
    marker = np.abs(np.linalg.norm(points - MARKER, axis=1) - 0.1) < 1e-5
    return ball, cube, marker


@pytest.mark.parametrize("height, width", [(65, 65), (40, 90)])
@pytest.mark.parametrize("free", [False, True])
def test_depth_equals_an_analytic_scene_of_plane_balls_and_cube(height, width, free):
    model, data = scene(BALLS, visual='<global fovy="60"/>')
    place = {"position": (0, 0, 2), "lookat": (0, 0, 0)} if free else {"camera": "down"}
    depth = RayCastCamera(model, **place, height=height, width=width).depth(data)

    half = np.tan(np.pi / 6)  # of the image's height, a metre away
    up = half * (1 - (np.arange(height) + 0.5) / height * 2)
    right = half * width / height * ((np.arange(width) + 0.5) / width * 2 - 1)
    x, y = np.meshgrid(right, up)  # direction (x, y, -1) from (0, 0, 2): depth is the parameter
    expected = np.full((height, width), 2.0)
    for center, radius in ((BALL, 0.3), (MARKER, 0.1)):
        a, b = x**2 + y**2 + 1, x * center[0] + y * center[1] + 2 - center[2]
        c = center[0] ** 2 + center[1] ** 2 + (2 - center[2]) ** 2 - radius**2
        with np.errstate(invalid="ignore"):
            expected = np.fmin(expected, (b - np.sqrt(b**2 - a * c)) / a)
    inner = (np.abs(1.6 * x + 0.5) < 0.2) & (np.abs(1.6 * y + 0.3) < 0.2)
    outer = (np.abs(2 * x + 0.5) < 0.32) & (np.abs(2 * y + 0.3) < 0.32)
    expected[inner] = 1.6
    sides = outer & ~inner  # left to the test of points
    np.testing.assert_allclose(depth[~sides], expected[~sides], atol=1e-5)
    assert (depth < 1.5).sum() > 20 and inner.sum() > 20  # balls and cube were in view at all


def test_points_lie_on_what_is_seen_and_the_floor_only_hides():
    model, data = scene(BALLS)
    camera = RayCastCamera(model, "down", height=60, width=60)
    points = camera.points(data)
    assert points.dtype == np.float32
    np.testing.assert_array_equal(np.sum(on_surfaces(points), axis=0), 1)
    _, hit = camera.cast(data, *rays_of(camera, data), camera.types)
    geoms = [model.geom("ball").id, model.geom("cube").id, model.ngeom + model.site("marker").id]
    counts = [(hit == geom).sum() for geom in geoms]
    assert [mask.sum() for mask in on_surfaces(points)] == counts and min(counts) > 5

    with_floor = RayCastCamera(model, "down", height=60, width=60, background=()).points(data)
    assert len(with_floor) == 60 * 60 and (np.abs(with_floor[:, 2]) < 1e-5).sum() > 1000


@pytest.mark.parametrize(
    "box",
    [
        ((-0.45, -0.45, 0.05), (0.45, 0.3, 0.55)),  # cuts the ball, the cube and the marker
        ((-1, -1, 0.399), (1, 1, 0.401)),  # the top of the cube, and a slice of the ball
        ((-1, -1, -1), (0.3, 0.3, 3)),  # the camera is inside
        ((-1, -1, 3), (1, 1, 4)),  # behind the camera
    ],
)
def test_only_points_in_the_box_are_returned_and_all_of_them(box):
    model, data = scene(BALLS)
    points = RayCastCamera(model, "down").points(data)
    inside = ((points >= box[0]) & (points <= box[1])).all(axis=1)
    cut = RayCastCamera(model, "down", box=box).points(data)
    np.testing.assert_array_equal(cut, points[inside])
    assert len(cut) > 50 or (box[0][2] == 3 and cut.shape == (0, 3))


def test_points_whose_rays_run_in_a_face_of_the_box_are_kept():
    xml = """<mujoco><worldbody><body pos="0 1 1">
      <geom name="wall" type="box" size="2 0.1 2"/>
    </body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    view = {"position": (0, -2, 1), "lookat": (0, 0, 1), "width": 65, "height": 65}
    points = RayCastCamera(model, **view).points(data)
    inside = points[points[:, 0] >= 0]
    assert (inside[:, 0] == 0).sum() > 20  # the middle column of the picture
    box = ((0.0, -5.0, -5.0), (5.0, 5.0, 5.0))
    np.testing.assert_array_equal(RayCastCamera(model, box=box, **view).points(data), inside)


def test_colors_and_ids_are_those_of_geoms_and_sites():
    model, data = scene(BALLS)
    camera = RayCastCamera(model, "down")
    points, ids = camera.points(data, color=True, segmentation=True)
    assert points.shape == (len(ids), 6) and points.dtype == np.float32
    np.testing.assert_array_equal(points[:, :3], camera.points(data))
    ball, cube, marker = on_surfaces(points[:, :3])
    np.testing.assert_array_equal(ids[ball], model.geom("ball").id)
    np.testing.assert_array_equal(ids[cube], model.geom("cube").id)
    np.testing.assert_array_equal(ids[marker], model.ngeom + model.site("marker").id)
    np.testing.assert_array_equal(points[ball, 3:], np.tile((1, 0, 0), (ball.sum(), 1)))
    np.testing.assert_array_equal(points[cube, 3:], 0.5)
    np.testing.assert_array_equal(points[marker, 3:], np.tile((0, 1, 0), (marker.sum(), 1)))


MATERIALS = """
  <texture name="half" type="2d" builtin="checker" width="64" height="64" rgb2="0 0 1"
    rgb1="1 1 1"/>
  <material name="opaque" rgba="0 1 0 1"/>
  <material name="clear" rgba="0 1 0 0"/>
  <material name="checker" texture="half" rgba="1 1 1 1"/>
"""


def test_a_geoms_own_color_goes_before_its_materials_as_in_mujocos_renderer():
    world = """
      <camera name="down" pos="0 0 3"/>
      <body>
        <geom type="box" size="0.2 0.2 0.2" pos="-0.5 0 0" material="opaque"/>
        <geom type="box" size="0.2 0.2 0.2" pos="-0.5 0 0.5" material="opaque" rgba="1 0 0 0"/>
        <geom type="box" size="0.2 0.2 0.2" pos="0 0 0" material="clear" rgba="1 0 0 1"/>
        <geom type="box" size="0.2 0.2 0.2" pos="0.5 0 0" material="checker"/>
      </body>"""
    model, data = scene(world, MATERIALS)
    points, ids = RayCastCamera(model, "down").points(data, color=True, segmentation=True)
    colors = {int(geom): points[ids == geom, 3:].mean(axis=0) for geom in np.unique(ids)}
    assert set(colors) == {0, 2, 3}  # the second is not drawn, though `mj_ray` meets it
    np.testing.assert_allclose(colors[0], (0, 1, 0))
    np.testing.assert_allclose(colors[2], (1, 0, 0))
    np.testing.assert_allclose(colors[3], (0.5, 0.5, 1), atol=0.02)


@pytest.mark.parametrize(
    "shape",
    [
        'type="sphere" size="0.3"',
        'type="capsule" size="0.1 0.3"',
        'type="ellipsoid" size="0.1 0.2 0.3"',
        'type="cylinder" size="0.2 0.3"',
        'type="box" size="0.1 0.2 0.3"',
    ],
)
def test_a_site_looks_like_a_geom_of_its_shape_unless_sites_are_not_to_be_seen(shape):
    body = '<body pos="5.1 0 0" euler="10 20 30">{}</body><camera name="down" pos="5 0 3"/>'
    model, data = scene(body.format(f"<site {shape}/>"))
    geom_model, geom_data = scene(body.format(f"<geom {shape}/>"))
    depth = RayCastCamera(model, "down").depth(data)
    np.testing.assert_array_equal(depth, RayCastCamera(geom_model, "down").depth(geom_data))
    assert np.isfinite(depth).sum() > 50
    assert np.isinf(RayCastCamera(model, "down", sites=False).depth(data)).all()
    assert np.isinf(RayCastCamera(model, "down", hidden_sites=[0]).depth(data)).all()


def test_only_meshes_become_ellipsoids():
    world = """
      <camera name="down" pos="0 0 6"/>
      <body name="link" pos="-2 0 0">
        <geom type="mesh" mesh="tetrahedron"/>
        <geom type="box" size="0.2 0.2 0.2" pos="3 0 0"/>
      </body>
      <body><geom type="mesh" mesh="tetrahedron" pos="0 1 0"/></body>"""
    model, data = scene(world, TETRAHEDRON)
    exact = RayCastCamera(model, "down").points(data, segmentation=True)
    rough = RayCastCamera(model, "down", ellipsoids=("link",)).points(data, segmentation=True)
    for geom, same in enumerate((False, True, True)):
        before, after = (points[ids == geom] for points, ids in (exact, rough))
        assert len(before) > 20 and np.array_equal(before, after) == same


def test_groups_can_be_chosen():
    model, data = scene(GROUPS + '<camera name="side" pos="0 -5 0" xyaxes="1 0 0 0 0 1"/>')
    camera = RayCastCamera(model, "side", groups=(0, 5), background=())
    _, ids = camera.points(data, segmentation=True)
    seen = {int(group) for group in model.geom_group[np.unique(ids)]}
    assert seen == {-3, 0, 5, 7}  # MuJoCo counts what is beyond 0 to 5 as these


# ---- Where the camera is -------------------------------------------------------------------------


def test_cameras_on_a_post_on_a_cart_and_at_a_body_see_from_where_they_are():
    model, data = scene(BALLS)
    down = RayCastCamera(model, "down").depth(data)
    post = RayCastCamera(model, "on a post")
    np.testing.assert_allclose(post.depth(data), down, atol=1e-12)

    cart, ball = RayCastCamera(model, "on a cart"), RayCastCamera(model, "at the ball")
    counts = []
    for shift in (0, 0.5, 1):  # the cart turned a quarter: its y is the world's -x
        data.joint("rail").qpos = shift
        mujoco.mj_forward(model, data)
        surfaces = on_surfaces(cart.points(data))
        np.testing.assert_array_equal(np.sum(surfaces, axis=0), 1)
        counts.append(np.sum(surfaces, axis=1).tolist())
    assert counts[0] != counts[1]
    same = np.isclose(cart.depth(data), np.rot90(down, -1))  # now it is above the middle
    assert same.mean() > 0.999  # an edge may fall on either side

    middle = ball.depth(data)[42, 42]  # of 84: half a pixel beside the middle
    assert middle == pytest.approx(np.linalg.norm(np.subtract((2, 1, 2), BALL)) - 0.3, abs=1e-2)
    assert on_surfaces(ball.points(data))[0].sum() > 50


def test_a_free_camera_is_upright_and_its_middle_is_what_it_looks_at():
    world = """
      <body><geom type="sphere" size="0.1" pos="1 2 3"/></body>
      <body><geom type="sphere" size="0.1" pos="1 2 3.5"/></body>"""
    model, data = scene(world)
    for position in ((4, 2, 3), (1, -2, 5), (-2, 3, 1)):
        camera = RayCastCamera(model, position=position, lookat=(1, 2, 3), height=101, width=101)
        _, hit = camera.cast(data, *rays_of(camera, data), camera.types)
        rows, columns = np.nonzero(hit.reshape(101, 101) == 0)
        np.testing.assert_allclose((rows.mean(), columns.mean()), 50, atol=0.5)
        rows, columns = np.nonzero(hit.reshape(101, 101) == 1)
        assert rows.mean() < 40 and abs(columns.mean() - 50) < 0.5


def test_the_model_of_the_caller_is_left_as_it_was():
    env = MetaWorldPointCloudEnv("reach")
    env.begin(0)
    model, data = env.sawyer_env.model, env.sawyer_env.data

    def everything():
        buffer = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        return buffer

    before = everything()
    camera = RayCastCamera(model, "corner2", ellipsoids=("right_l4",), groups=(0,))
    camera.points(data)
    camera.depth(data)
    camera.render(data, 8, 8)
    np.testing.assert_array_equal(everything(), before)


# ---- What is refused -----------------------------------------------------------------------------

LENS = 'sensorsize="0.01 0.01" focal="0.01 0.01" resolution="10 10"'
CLOTH = """
  <flexcomp name="cloth" type="grid" count="3 3 1" spacing="0.2 0.2 0.2" dim="2" {}>
    <edge equality="true"/>
  </flexcomp>"""


@pytest.mark.parametrize(
    "world, arguments, message",
    [
        ('<camera name="a" orthographic="true"/>', {"camera": "a"}, "an orthographic camera"),
        (f'<camera name="a" {LENS}/>', {"camera": "a"}, "'a' has a lens of its own"),
        ('<camera name="a"/>', {}, "give either a camera"),
        ('<camera name="a"/>', {"camera": "a", "position": (0, 0, 1)}, "give either a camera"),
        ("", {"position": (0, 0, 1)}, "give either a camera"),
        ("", {"position": (0, 0, 1), "lookat": (0, 0, 1)}, "cannot look at that same point"),
        ('<camera name="a"/>', {"camera": "a", "box": ((0, 0, 1), (1, 1, 1))}, "the box is empty"),
        (CLOTH.format("") + '<camera name="a"/>', {"camera": "a"}, "rays do not meet a flex"),
    ],
)
def test_what_could_only_be_seen_wrongly_is_refused(world, arguments, message):
    model, _ = scene(world)
    with pytest.raises(ValueError, match=message):
        RayCastCamera(model, **arguments)


def test_an_orthographic_view_of_the_free_camera_is_refused():
    model, _ = scene("", visual='<global orthographic="true"/>')
    with pytest.raises(ValueError, match="an orthographic camera"):
        RayCastCamera(model, position=(0, 0, 1), lookat=(0, 0, 0))


def test_a_skin_is_refused_and_a_flex_that_is_not_drawn_is_not():
    skin = """
      <skin name="skin" vertex="0 0 0 1 0 0 0 1 0" face="0 1 2">
        <bone body="b" bindpos="0 0 0" bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 1 1"/>
      </skin>"""
    world = '<camera name="a"/><body name="b"><geom size="1"/></body>'
    xml = f"<mujoco><worldbody>{world}</worldbody><deformable>{skin}</deformable></mujoco>"
    with pytest.raises(ValueError, match="rays do not meet a skin"):
        RayCastCamera(mujoco.MjModel.from_xml_string(xml), "a")
    for unseen in ('group="3"', 'rgba="1 0 0 0"'):
        model, data = scene(CLOTH.format(unseen) + world)
        assert len(RayCastCamera(model, "a").points(data)) > 0


def test_data_without_poses_or_of_another_model_is_refused():
    model, _ = scene(BALLS)
    camera = RayCastCamera(model, "down")
    with pytest.raises(ValueError, match=r"call mujoco\.mj_forward"):
        camera.points(mujoco.MjData(model))
    with pytest.raises(ValueError, match="of another model"):
        camera.points(scene(PRIMITIVES)[1])
    with pytest.raises(KeyError, match="Invalid name 'dawn'"):
        RayCastCamera(model, "dawn")
    with pytest.raises(KeyError, match="Invalid name 'table'"):
        RayCastCamera(model, "down", background=("table",))


# ---- The file alone ------------------------------------------------------------------------------

# README shows these lines.
ANT = """\
import gymnasium
import matplotlib.pyplot as plt

from camera import RayCastCamera

ant = gymnasium.make("Ant-v5").unwrapped
ant.reset(seed=0)
points = RayCastCamera(ant.model, position=(2, -2, 2), lookat=(0, 0, 0.7)).points(ant.data)
plt.axes(projection="3d", box_aspect=points.max(0) - points.min(0)).scatter(*points.T)
plt.savefig("ant.png")
"""


def test_the_file_alone_in_an_empty_folder_draws_a_cloud_of_gymnasiums_ant(tmp_path, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    readme = (ROOT / "README.md").read_text()
    assert ANT in readme
    (tmp_path / "camera.py").write_text((ROOT / "camera.py").read_text())
    lines = f"import sys\nsys.path.insert(0, {str(tmp_path)!r})\n{ANT}print(len(points))"
    command = [sys.executable, "-I", "-c", lines]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 400
    picture = (tmp_path / "ant.png").read_bytes()
    assert picture.startswith(b"\x89PNG") and len(picture) > 20_000


# ---- Meta-World's scenes -------------------------------------------------------------------------


def test_ellipsoids_stand_in_for_the_arms_meshes_in_clouds_alone():
    """Their outlines share 0.85 of what either covers; the depth there is 14 mm off, the median."""
    env = MetaWorldPointCloudEnv("reach")
    model, data = copy.copy(env.sawyer_env.model), env.sawyer_env.data
    others = ~np.isin(np.arange(model.ngeom), env.arm_geoms)
    model.geom_group[others] = 3  # the arm alone
    camera = RayCastCamera(
        model, metaworld_env.CAMERA, sites=False, ellipsoids=metaworld_env.ARM_LINKS
    )
    common, either, apart = 0, 0, []
    for seed in range(4):
        env.begin(seed)
        for _ in range(30 * seed):
            env.advance(env.expert_action())
        origin, rays = rays_of(camera, data)
        exact, _ = camera.cast(data, origin, rays, camera.types)
        rough, _ = camera.cast(data, origin, rays, camera.cloud_types)
        both = np.isfinite(exact) & np.isfinite(rough)
        common += both.sum()
        either += (np.isfinite(exact) | np.isfinite(rough)).sum()
        apart.extend(np.abs(exact[both] - rough[both]))

        points = camera.points(data)
        points_expected = (origin + rough[:, None] * rays)[np.isfinite(rough)]
        np.testing.assert_allclose(points, points_expected, atol=1e-6)
        depth = (exact * -camera.rays[:, 2]).reshape(camera.height, camera.width)
        np.testing.assert_array_equal(camera.depth(data), depth)
    assert 0.8 < common / either < 0.95 and 0.001 < np.median(apart) < 0.02


RASTERIZE = """
import sys
try:
    import mujoco
    mujoco.GLContext(84, 84).make_current()
except Exception as error:
    sys.exit(f"NO OPENGL HERE, the rasterizer was not compared: {error}")
import numpy as np
import metaworld_env
images = []
for task in ("reach", "shelf-place", "window-open"):
    env = metaworld_env.MetaWorldPointCloudEnv(task)
    env.begin(0)
    camera = env.camera
    renderer = mujoco.Renderer(env.sawyer_env.model, camera.height, camera.width)
    renderer.enable_depth_rendering()
    renderer.update_scene(env.sawyer_env.data, metaworld_env.CAMERA)
    images.append((renderer.render(), camera.depth(env.sawyer_env.data)))
np.save(sys.argv[1], images)
"""


def test_depth_equals_mujocos_rasterizer_where_opengl_works(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "egl")  # it is chosen at import: in a process of its own
    command = [sys.executable, "-c", RASTERIZE, str(tmp_path / "depth.npy")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    if "NO OPENGL HERE" in done.stderr:
        pytest.skip(done.stderr.strip().splitlines()[-1])
    assert done.returncode == 0, done.stderr
    for rasterized, cast in np.load(tmp_path / "depth.npy"):
        sky = np.isinf(cast)
        assert (rasterized > 50).sum() == pytest.approx(sky.sum(), rel=0.01)
        off = np.abs(rasterized - cast)[~sky]
        assert np.quantile(off, 0.99) < 1e-4  # metres; silhouettes may differ by a pixel
