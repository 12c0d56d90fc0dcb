"""The MJCF files against numbers written here a second time, and the scene."""

import xml.etree.ElementTree as ElementTree

import mujoco
import numpy as np
import pytest

from mcx_jax.assets import asset_path
from mcx_jax.play import scene

H = 0.5**0.5
PI = np.pi

# name, position in parent m, quaternion wxyz, hinge axis, inertial position m, inertial
# quaternion, mass kg, principal inertia kg m2: the parameters the paper's authors published.
LINKS = (
    ("shoulder", (0, 0, 0.181), (1, 0, 0, 0), (0, 0, 1),
     (0, 0, 0), (1, 0, 0, 0), 7.778, (0.0314743, 0.0314743, 0.0218756)),
    ("upper_arm", (0, 0.176, 0), (H, 0, H, 0), (0, 1, 0),
     (0, 0, 0.3065), (1, 0, 0, 0), 12.93, (0.423074, 0.423074, 0.0363656)),
    ("forearm", (0, -0.137, 0.613), (1, 0, 0, 0), (0, 1, 0),
     (0, 0, 0.2855), (1, 0, 0, 0), 3.87, (0.11059, 0.11059, 0.0108844)),
    ("wrist_1", (0, 0, 0.571), (H, 0, H, 0), (0, 1, 0),
     (0, 0.135, 0), (0.5, 0.5, -0.5, 0.5), 1.96, (0.0055125, 0.00510825, 0.00510825)),
    ("wrist_2", (0, 0.135, 0), (1, 0, 0, 0), (0, 0, 1),
     (0, 0, 0.12), (0.5, 0.5, -0.5, 0.5), 1.96, (0.0055125, 0.00510825, 0.00510825)),
    ("wrist_3", (0, 0, 0.12), (1, 0, 0, 0), (0, 1, 0),
     (0, 0.100278, 0), (H, 0, 0, H), 0.302, (1.0002, 1.00019, 1.00019)),
)  # fmt: skip
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
RANGE_RAD = (2 * PI, 2 * PI, PI, 2 * PI, 2 * PI, 2 * PI)
TORQUE_NM = (330, 330, 150, 56, 56, 56)
SPEED_RAD_S = np.deg2rad((120, 120, 180, 180, 180, 180))
EXACT = {"rtol": 1e-12, "atol": 1e-15}
"""MuJoCo normalises quaternions when it compiles; everything else is copied digit by digit."""


@pytest.fixture(scope="module", params=["ur10e_paper.xml", "ur10e.xml"])
def arm(request):
    """Each arm model in turn."""
    return mujoco.MjModel.from_xml_path(str(asset_path(request.param)))


@pytest.fixture(scope="module")
def paper():
    """The paper's arm."""
    return mujoco.MjModel.from_xml_path(str(asset_path("ur10e_paper.xml")))


def test_chain(arm):
    assert (arm.nbody, arm.njnt, arm.nq, arm.nv) == (8, 6, 6, 6)
    parent = arm.body("base").id
    np.testing.assert_array_equal(arm.body("base").pos, 0)
    for (name, pos, quat, axis, *_), joint in zip(LINKS, JOINTS, strict=True):
        body = arm.body(name)
        assert body.parentid[0] == parent, name
        np.testing.assert_allclose(body.pos, pos, **EXACT, err_msg=name)
        np.testing.assert_allclose(body.quat, quat, **EXACT, err_msg=name)
        assert arm.joint(joint).type[0] == mujoco.mjtJoint.mjJNT_HINGE
        assert arm.joint(joint).bodyid[0] == body.id
        np.testing.assert_array_equal(arm.joint(joint).axis, axis, err_msg=joint)
        np.testing.assert_array_equal(arm.joint(joint).pos, 0, err_msg=joint)
        parent = body.id


def test_joint_order_and_ranges(arm):
    assert tuple(arm.joint(i).name for i in range(6)) == JOINTS
    np.testing.assert_allclose(arm.jnt_range[:, 1], RANGE_RAD, **EXACT)
    np.testing.assert_array_equal(arm.jnt_range[:, 0], -arm.jnt_range[:, 1])


@pytest.mark.parametrize("link", LINKS, ids=lambda link: link[0])
def test_inertias_of_the_paper(paper, link):
    name, *_, ipos, iquat, mass, inertia = link
    body = paper.body(name)
    np.testing.assert_allclose(body.ipos, ipos, **EXACT)
    np.testing.assert_allclose(body.iquat, iquat, **EXACT)
    assert body.mass[0] == mass
    np.testing.assert_array_equal(body.inertia, inertia)


def test_total_mass(paper):
    # 7.778 + 12.93 + 3.87 + 1.96 + 1.96 + 0.302 = 28.8 kg: the shapes weigh nothing.
    assert paper.body_mass.sum() == pytest.approx(28.8, abs=1e-12)


def test_wrist_3_of_the_paper_is_flange_plus_tool(paper):
    # The artefact explained: a flange of 0.202 kg at y = 0.092 m and a tool of 0.1 kg at the tool
    # site, y = 0.117 m, have their common centre at
    #   (0.202 * 0.092 + 0.1 * 0.117) / 0.302 = 0.030284 / 0.302 = 0.100278 m,
    # and the tool came with 1 kg m2 about each axis: 1 + 0.0002 is what is in the table.
    assert paper.body("wrist_3").ipos[1] == pytest.approx(0.030284 / 0.302, abs=5e-7)
    flange = mujoco.MjModel.from_xml_path(str(asset_path("ur10e.xml"))).body("wrist_3")
    assert flange.mass[0] == 0.202
    np.testing.assert_array_equal(flange.ipos, (0, 0.092, 0))
    # About the symmetry axis the tool adds exactly its own 1 kg m2 ...
    assert paper.body("wrist_3").inertia[0] == pytest.approx(1 + flange.inertia[0], abs=5e-6)
    # ... and across it Steiner's terms too: 0.202 * 0.008278^2 + 0.1 * 0.016722^2 = 4.18e-5.
    assert paper.body("wrist_3").inertia[1] == pytest.approx(
        1 + flange.inertia[1] + 4.18e-5, abs=5e-6
    )


def test_manufacturers_flange_is_a_solid_cylinder():
    # 0.202 kg, radius 45 mm, length 50 mm: m r^2 / 2 along, m (3 r^2 + l^2) / 12 across the axis,
    # 0.202 * 0.002025 / 2 = 2.04525e-4 and 0.202 * (0.006075 + 0.0025) / 12 = 1.44346e-4.
    flange = mujoco.MjModel.from_xml_path(str(asset_path("ur10e.xml"))).body("wrist_3")
    np.testing.assert_allclose(flange.inertia, (2.04525e-4, 1.44346e-4, 1.44346e-4), rtol=5e-6)
    # Its axis is the joint's: the first principal axis points along y of the body.
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, flange.iquat)
    np.testing.assert_allclose(axes.reshape(3, 3)[:, 0], (0, 1, 0), atol=1e-15)


def test_options(paper, arm):
    for model in (paper, arm):
        assert model.opt.timestep == 0.002
        np.testing.assert_array_equal(model.opt.gravity, (0, 0, -9.81))
        assert model.opt.disableflags == (
            mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        )
        np.testing.assert_array_equal(model.body_gravcomp, 0)
    assert paper.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER


def test_passive_forces(paper):
    for passive in (paper.dof_armature, paper.dof_damping, paper.dof_frictionloss):
        np.testing.assert_array_equal(passive, 0)
    np.testing.assert_array_equal(paper.jnt_stiffness, 0)


def test_ur10e_differs_where_it_says(paper):
    """`ur10e.xml` is the paper's file but for integrator, armature and wrist 3."""
    quiet = mujoco.MjModel.from_xml_path(str(asset_path("ur10e.xml")))
    assert quiet.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    np.testing.assert_array_equal(quiet.dof_armature, (1.2, 1.2, 0.5, 0.15, 0.15, 0.15))
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        np.testing.assert_array_equal(
            getattr(quiet, name)[:-1], getattr(paper, name)[:-1], err_msg=name
        )
    same = ("dof_damping", "actuator_gainprm", "actuator_biasprm", "geom_size", "geom_pos")
    for name in (*same, "geom_matid", "mat_rgba", "site_pos", "site_quat"):
        np.testing.assert_array_equal(getattr(quiet, name), getattr(paper, name), err_msg=name)


def test_actuators(arm):
    assert arm.nu == 12 and arm.na == 0
    names = [f"{joint}_{kind}" for kind in ("position", "velocity") for joint in JOINTS]
    assert [arm.actuator(i).name for i in range(12)] == names
    np.testing.assert_array_equal(arm.actuator_trnid[:, 0], [*range(6), *range(6)])
    np.testing.assert_array_equal(arm.actuator_gear[:, 0], 1)
    # force = gain * ctrl + bias . (1, q, qd)
    np.testing.assert_array_equal(arm.actuator_gainprm[:, 0], [1e5] * 6 + [1e3] * 6)
    np.testing.assert_array_equal(
        arm.actuator_biasprm[:, :3], [(0, -1e5, 0)] * 6 + [(0, 0, -1e3)] * 6
    )
    np.testing.assert_array_equal(arm.actuator_forcelimited, 1)
    np.testing.assert_array_equal(arm.actuator_forcerange[:, 1], TORQUE_NM + TORQUE_NM)
    np.testing.assert_array_equal(arm.actuator_forcerange[:, 0], -arm.actuator_forcerange[:, 1])
    np.testing.assert_array_equal(arm.actuator_ctrllimited, [0] * 6 + [1] * 6)
    np.testing.assert_allclose(arm.actuator_ctrlrange[6:, 1], SPEED_RAD_S, **EXACT)
    np.testing.assert_array_equal(arm.actuator_ctrlrange[6:, 0], -arm.actuator_ctrlrange[6:, 1])


def test_tool_pose_at_zero(arm):
    # At q = 0 the upper arm frame is turned by 90 deg about y (its z is x of the base), wrist 1 by
    # another 90 deg (its z is -z of the base, its x is -x); y is y all along the chain.
    #   x: 0.613 + 0.571                              = 1.184
    #   y: 0.176 - 0.137 + 0.135 + 0.117 (site)       = 0.291
    #   z: 0.181 - 0.120 (wrist 3 along wrist 2's z)  = 0.061
    # Orientation Ry(180) Rx(-90): Rx(-90) takes y to -z and z to y, Ry(180) negates x and z, so the
    # tool's axes in the base are x -> -x, y -> -(-z) = +z, z -> +y (out of the flange).
    data = mujoco.MjData(arm)
    mujoco.mj_kinematics(arm, data)
    np.testing.assert_allclose(data.site("tool").xpos, (1.184, 0.291, 0.061), atol=1e-12)
    np.testing.assert_allclose(
        data.site("tool").xmat.reshape(3, 3), [[-1, 0, 0], [0, 0, 1], [0, 1, 0]], atol=1e-12
    )


def test_sag_is_a_third_of_a_millimetre(arm):
    """The servo has no gravity compensation: at rest the tool hangs about 0.3 mm low."""
    arm.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data = mujoco.MjData(arm)
    data.qpos[:] = data.ctrl[:6] = scene.START_POSE_RAD
    mujoco.mj_kinematics(arm, data)
    height_m = data.site("tool").xpos[2]
    mujoco.mj_step(arm, data, nstep=2000)
    mujoco.mj_kinematics(arm, data)
    assert np.abs(data.qvel).max() < 1e-6
    assert 1e-4 < height_m - data.site("tool").xpos[2] < 6e-4


def test_arm_files_have_no_mesh_and_shapes_do_not_collide(arm):
    assert arm.nmesh == 0
    np.testing.assert_array_equal(arm.geom_contype, 0)
    np.testing.assert_array_equal(arm.geom_conaffinity, 0)
    np.testing.assert_array_equal(arm.geom_group, 2)


@pytest.mark.parametrize("name", ["ur10e_paper.xml", "ur10e.xml"])
def test_every_moving_body_has_its_inertial_written(name):
    root = ElementTree.parse(asset_path(name)).getroot()
    bodies = {body.get("name"): body for body in root.iter("body")}
    assert {n for n, body in bodies.items() if body.find("inertial") is None} == {"base"}


def test_scene_rest_poses():
    model = scene.build_scene()
    data = mujoco.MjData(model)
    scene.pose_scene(model, data, scene.REACH_POSE_RAD)
    # Frame B is the deck origin of vessel A; vessel B rests 0.65 m ahead, turned by 180 deg.
    np.testing.assert_array_equal(data.body("arm/base").xpos, 0)
    np.testing.assert_allclose(data.body("vessel_b").xpos, (0.65, 0, 0))
    np.testing.assert_allclose(np.diag(data.body("vessel_b").xmat.reshape(3, 3)), (-1, -1, 1))
    # Goal: Rz(180) times a turn by pi about (cos 45, sin 45, 0), which swaps x and y and negates z:
    # x -> -y, y -> -x, z -> -z in the world.
    goal = data.body("goal").xmat.reshape(3, 3)
    np.testing.assert_allclose(goal, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], atol=1e-12)
    # The pose for still pictures reaches it; it is written with four decimals.
    np.testing.assert_allclose(data.site("arm/tool").xpos, data.body("goal").xpos, atol=1e-4)
    np.testing.assert_allclose(data.site("arm/tool").xmat.reshape(3, 3), goal, atol=3e-4)


def test_scene_poses_move_the_arm_with_its_vessel():
    model = scene.build_scene(asset_path("ur10e.xml"))
    data = mujoco.MjData(model)
    half = np.deg2rad(10) / 2
    scene.pose_scene(
        model,
        data,
        vessel_a=((0.01, 0.02, 0.03), (np.cos(half), np.sin(half), 0, 0)),
        goal=((0.6, 0.1, 0.2), (1, 0, 0, 0)),
    )
    np.testing.assert_allclose(data.body("arm/base").xpos, (0.01, 0.02, 0.03))
    np.testing.assert_allclose(data.body("arm/base").xquat, (np.cos(half), np.sin(half), 0, 0))
    np.testing.assert_allclose(data.body("goal").xpos, (0.6, 0.1, 0.2))
    np.testing.assert_allclose(data.body("vessel_b").xpos, (0.65, 0, 0))


def test_scene_cameras_and_shapes():
    model = scene.build_scene()
    names = {model.camera(i).name for i in range(model.ncam)}
    assert names == {"hero", "pair"}
    assert model.body("vessel_a").mocapid[0] >= 0
    np.testing.assert_array_equal(model.geom_contype, 0)
