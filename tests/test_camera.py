"""Tests of camera.py against analytic scenes, Meta-World and, where it runs, OpenGL."""

import subprocess
import sys
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
from scipy.spatial import cKDTree

import metaworld_env
from camera import FEW_RAYS, RayCastCamera, meet_ellipsoid
from metaworld_env import MetaWorldPointCloudEnv

ROOT = Path(metaworld_env.__file__).resolve().parent

# ---- Small scenes, and a model of another package ------------------------------------------------

SCENE = """
<mujoco><asset><material name="opaque" rgba="1 1 1 1"/></asset><worldbody>
  <camera name="down" pos="0 0 2" fovy="60"/>
  <camera name="turned" pos="0 0 2" mode="targetbody" target="b"/>
  <geom type="plane" size="5 5 1"/>
  <body name="b"><camera name="carried"/><geom type="sphere" size="0.3" pos="0.4 0.3 0.5"/></body>
  <body><geom name="cube" type="box" size="0.2 0.2 0.2" pos="-0.5 -0.3 0.2"/></body>
  <body><geom name="hidden by the floor" type="sphere" size="0.1" pos="0.4 -0.4 -0.3"/></body>
  <geom type="box" size="0.2 0.2 0.2" pos="0 0 1.5" rgba="1 0 0 0" material="opaque"/>
  <geom type="box" size="0.2 0.2 0.2" pos="0 0 1.5" group="4"/>
  <site name="marker" type="sphere" size="0.1" pos="-0.4 0.4 0.6"/>
  <site type="sphere" size="0.3" pos="0 0 1" rgba="1 0 0 0"/>
</worldbody></mujoco>
"""


def scene(pixels, box, camera="down"):
    """A camera that looks down on SCENE, and its state."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    physics = mujoco.MjData(model)
    mujoco.mj_forward(model, physics)
    return RayCastCamera(model, pixels, box, camera), physics


def test_depth_equals_an_analytic_scene_of_plane_balls_and_cube():
    pixels = 65
    camera, physics = scene(pixels, ((-1, -1, 0.01), (1, 1, 1)))
    across = np.tan(np.pi / 6) * ((np.arange(pixels) + 0.5) / pixels * 2 - 1)
    x, y = np.meshgrid(across, -across)  # direction (x, y, -1) from (0, 0, 2): depth is parameter
    expected = np.full((pixels, pixels), 2.0)
    for center, radius in (((0.4, 0.3, 0.5), 0.3), ((-0.4, 0.4, 0.6), 0.1)):
        a, b = x**2 + y**2 + 1, x * center[0] + y * center[1] + 2 - center[2]
        c = center[0] ** 2 + center[1] ** 2 + (2 - center[2]) ** 2 - radius**2
        with np.errstate(invalid="ignore"):
            expected = np.fmin(expected, (b - np.sqrt(b**2 - a * c)) / a)
    inner = (np.abs(1.6 * x + 0.5) < 0.2) & (np.abs(1.6 * y + 0.3) < 0.2)
    outer = (np.abs(2 * x + 0.5) < 0.32) & (np.abs(2 * y + 0.3) < 0.32)
    sides = outer & ~inner  # left to the test of the top
    depth = camera.depth(physics)
    expected[inner] = 1.6
    np.testing.assert_allclose(depth[~sides], expected[~sides], atol=1e-5)
    assert (depth < 1.5).sum() > 20 and inner.sum() > 20  # balls and cube were in view at all


def test_points_lie_on_what_the_camera_sees_of_objects_and_small_ones_get_more():
    camera, physics = scene(40, ((-1, -1, -1), (1, 1, 0.7)))
    points = camera.points(physics)
    on_ball = np.abs(np.linalg.norm(points - (0.4, 0.3, 0.5), axis=1) - 0.3) < 1e-4
    on_marker = np.abs(np.linalg.norm(points - (-0.4, 0.4, 0.6), axis=1) - 0.1) < 1e-4
    on_cube = np.abs(np.abs(points - (-0.5, -0.3, 0.2)).max(axis=1) - 0.2) < 1e-4
    assert (on_ball | on_marker | on_cube).all()
    finer, few = 80, []
    for pixels in (40, finer):
        rays = camera.rays(pixels)
        distance, hit = camera.cast(physics, rays)
        low = camera.origin[2] + distance * rays[:, 2] <= 0.7
        few.append((hit[low] < -1).sum())
        counted = [(hit[low] == geom).sum() for geom in (3, 4)]  # ball and cube
        if pixels == 40:
            assert [on_ball.sum(), on_cube.sum()] == counted and min(counted) >= FEW_RAYS
    assert few[0] < FEW_RAYS and on_marker.sum() == few[1] > 3 * few[0]


def test_a_marker_above_the_workspace_hides_nothing_in_it():
    camera, physics = scene(66, ((-1, -1, -1), (1, 1, 0.7)))
    before = camera.points(physics)
    on_marker = np.abs(np.linalg.norm(before - (-0.4, 0.4, 0.6), axis=1) - 0.1) < 1e-4
    physics.site("marker").xpos[:] = (-0.25, -0.15, 1.2)  # halfway from the camera to the cube
    np.testing.assert_array_equal(camera.points(physics), before[~on_marker])


def test_a_camera_that_could_only_be_silent_is_refused():
    for name in ("carried", "turned"):
        with pytest.raises(ValueError, match=f"'{name}' moves with a body"):
            scene(8, ((-1, -1, -1), (1, 1, 1)), name)
    with pytest.raises(ValueError, match="'down' does not see the workspace"):
        scene(8, ((-1, -1, 3), (1, 1, 4)))


def test_the_camera_sees_a_model_of_another_package():
    path = Path(gymnasium.__file__).parent / "envs/mujoco/assets/pusher_v5.xml"
    spec = mujoco.MjSpec.from_file(str(path))
    spec.worldbody.add_camera(name="above", pos=(0.45, -0.05, 1.5))  # it looks down
    model = spec.compile()
    physics = mujoco.MjData(model)
    mujoco.mj_forward(model, physics)
    box = ((-0.3, -0.8, -0.4), (1.2, 0.7, 0.5))
    camera = RayCastCamera(model, pixels=64, box=box, camera="above")
    points = camera.points(physics)
    middle, radius = physics.body("object").xpos, model.geom(model.body("object").geomadr[0]).size
    on_object = np.linalg.norm(points[:, :2] - middle[:2], axis=1) < radius[0] + 1e-6
    assert 20 < on_object.sum() < len(points)  # the puck, and the arm

    arm = [model.body(i).name for i in range(model.nbody) if model.body(i).name.startswith("r_")]
    camera = RayCastCamera(model, pixels=64, box=box, camera="above", arm=arm)
    objects, of_arm = camera.points(physics), camera.arm_points(physics)
    np.testing.assert_allclose(objects, points[np.isin(points, objects).all(axis=1)])
    assert len(of_arm) > 50 and not np.isin(of_arm, objects).all(axis=1).any()


def test_a_camera_inside_an_ellipsoid_looks_through_it():
    rays, half = np.eye(3), np.array([0.1, 0.2, 0.3])
    for center in ((0.05, 0, 0), (1.0, 0, 0)):
        distance = meet_ellipsoid(np.zeros(3), rays, np.array(center), np.eye(3), half)
        expected = [0.9 if center[0] == 1 else np.inf, np.inf, np.inf]
        np.testing.assert_allclose(distance, expected)


def test_the_file_alone_in_an_empty_folder_makes_a_cloud(tmp_path):
    (tmp_path / "camera.py").write_text((ROOT / "camera.py").read_text())
    (tmp_path / "scene.xml").write_text(SCENE)
    command = [sys.executable, "-I", "-c", ALONE, str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 100


ALONE = """
import sys
sys.path.insert(0, sys.argv[1])
import mujoco
from camera import RayCastCamera
model = mujoco.MjModel.from_xml_path("scene.xml")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
camera = RayCastCamera(model, pixels=40, box=((-1, -1, -1), (1, 1, 1)), camera="down")
print(len(camera.points(data)))
"""

# ---- Meta-World's scenes -------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["hand-insert", "door-open"])
def test_points_are_what_rays_meet_first_and_nothing_is_left_out(task):
    env = MetaWorldPointCloudEnv(task)
    env.begin(1)
    for _ in range(40):
        env.advance(env.expert_action())
    model, physics = env.sawyer_env.model, env.sawyer_env.data
    camera = RayCastCamera(
        model,
        pixels=84,
        box=metaworld_env.WORKSPACE,
        camera=metaworld_env.CAMERA,
        position=metaworld_env.CAMERA_POSITION,
    )  # the arm is not declared: its exact shape is seen
    points = camera.points(physics)
    away = np.linalg.norm(points - camera.origin, axis=1)
    distance, hit = camera.cast(physics, (points - camera.origin) / away[:, None])
    np.testing.assert_allclose(distance, away, atol=1e-5)  # nothing is before them
    assert ((hit < -1) | ~camera.background_geoms[hit]).all()

    rays = camera.rays(84)
    distance, hit = camera.cast(physics, rays)
    seen = (hit < -1) | ((hit >= 0) & ~camera.background_geoms[hit])
    every = camera.origin + distance[seen, None] * rays[seen]
    every = every[((every >= camera.low) & (every <= camera.high)).all(axis=1)]
    apart = cKDTree(points).query(every)[0]
    assert np.median(apart) < 1e-6 and np.quantile(apart, 0.99) < 0.01  # a pixel is a centimetre


def test_ellipsoids_hide_what_the_arm_hides():
    """Their outline differs: 0.86 of what both cover is common, where the depth is 1 cm off."""
    env = MetaWorldPointCloudEnv("reach")
    camera, common, either, apart = env.camera, 0, 0, []
    links = np.isin(np.arange(camera.model.ngeom), camera.arm_geoms)
    for seed in range(4):
        env.begin(seed)
        for _ in range(30 * seed):
            env.advance(env.expert_action())
        rays, physics = camera.workspace_rays, env.sawyer_env.data
        exact, _ = camera.cast(physics, rays, geoms=links, sites=())
        rough = camera.cast_at_arm(physics, rays)
        both = np.isfinite(exact) & np.isfinite(rough)
        common += both.sum()
        either += (np.isfinite(exact) | np.isfinite(rough)).sum()
        apart.extend(np.abs(exact[both] - rough[both]))
    assert common / either > 0.82 and np.median(apart) < 0.013


def test_what_stands_still_is_met_once_an_episode():
    env = MetaWorldPointCloudEnv("shelf-place")
    met = []
    for seed in (0, 1):  # each puts the shelf elsewhere
        env.begin(seed)
        for _ in range(3):
            env.cloud()
            met.append(env.camera.static_hits)
            env.advance(env.expert_action())
    assert met[0] is met[1] is met[2] is not met[3] is met[4] is met[5]


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
    renderer = mujoco.Renderer(env.sawyer_env.model, 84, 84)
    renderer.enable_depth_rendering()
    renderer.update_scene(env.sawyer_env.data, metaworld_env.CAMERA)
    images.append((renderer.render(), env.camera.depth(env.sawyer_env.data)))
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
