"""Serial arms with everything that the chain engine models, and C MuJoCo's step of them."""

import mujoco
import numpy as np

HEAD = """<mujoco><compiler angle="radian"/>
<option timestep="0.002" gravity="1.5 -3 -8.5">
<flag contact="disable" constraint="disable"/></option>
<default><geom type="ellipsoid" size=".08 .05 .03"/></default>
"""

FOUR = (
    HEAD
    + """
<worldbody>
 <body name="plinth" pos=".2 -.1 .4" quat=".9 .1 -.3 .2"><geom size=".2 .2 .1"/>
  <body pos=".05 .02 .1" quat=".8 .3 .2 -.4">
   <joint name="a" axis=".3 -.5 .8" pos=".03 -.02 .01" damping="1.5" armature=".3" ref=".4"/>
   <geom mass="3" pos=".1 .02 .05" quat=".7 .2 .5 .1"/>
   <body pos=".3 .05 -.02" quat=".6 -.5 .3 .4">
    <joint name="b" axis="-.9 .2 .1" pos="-.05 .04 .02" damping=".2" ref="-1.1"/>
    <geom mass="2" pos=".15 -.03 .02"/>
    <body pos="0 .1 .1" quat=".5 .5 .1 .7"><geom mass=".7" pos=".03 0 .02"/>
     <body pos=".1 .1 0" quat=".3 .9 .2 .1">
      <joint name="c" axis=".1 .7 -.6" armature=".05" damping=".05"/>
      <geom mass="1.2" pos="0 .08 .03" quat=".2 .3 .9 .4"/>
      <body pos=".05 .1 .2"><joint name="d" axis="1 1 1" pos=".01 .02 .03" ref="2" damping=".01"/>
       <geom mass=".6" pos=".04 .02 .1"/>
       <body pos=".02 .03 .1" quat=".1 .2 .3 .4"><geom mass=".3" pos=".05 0 0"/></body>
</body></body></body></body></body></body></worldbody>
<actuator>
 <motor joint="d" gear="3" ctrlrange="-.5 .5"/>
 <position joint="a" kp="200" kv="15" forcerange="-60 40"/>
 <velocity joint="b" kv="12" gear="-2" forcerange="-18 30"/>
 <position joint="c" kp="50" kv="2" gear="1.7" ctrlrange="-1 1.5"/>
 <motor joint="a" gear="-20" forcerange="-.6 .3"/>
</actuator></mujoco>"""
)

SIX = (
    HEAD
    + """
<worldbody>
 <body pos="0 0 .2" quat=".9 0 .2 .1"><joint name="a" axis=".1 .2 1" armature=".8" damping="3"/>
  <geom mass="5" pos=".02 .05 .1"/>
  <body pos=".1 .1 .15" quat=".7 .7 .1 0">
   <joint name="b" axis="0 1 .2" pos=".02 0 .03" armature=".5" ref=".7"/>
   <geom mass="6" pos=".2 0 .05"/>
   <body pos=".4 -.1 0" quat=".9 -.1 .1 .4">
    <joint name="c" axis="-.3 1 0" pos="0 .04 0" damping=".5"/><geom mass="3" pos=".15 .02 0"/>
    <body pos=".3 .05 .02" quat=".6 .1 .7 .2">
     <joint name="d" axis="1 .1 -.2" armature=".1" ref="-.3" damping=".1"/>
     <geom mass="1.5" pos=".05 .02 .03"/>
     <body pos=".02 .1 .03" quat=".4 .5 -.6 .3">
      <joint name="e" axis=".2 -.1 -1" pos=".01 -.01 .02" armature=".1"/>
      <geom mass="1" pos=".03 .06 0"/>
      <body pos="0 .08 .02"><joint name="f" axis=".5 .5 -.7" damping=".02"/>
       <geom mass=".5" pos=".02 .03 .05"/>
       <body pos=".03 0 .1" quat=".8 .1 .1 .6"><geom mass=".4" pos=".02 .01 .03"/></body>
</body></body></body></body></body></body></worldbody>
<actuator>
 <position joint="a" kp="2000" kv="120" armature=".3" damping="2" forcerange="-200 150"/>
 <position joint="b" kp="3000" forcerange="-250 250" ctrlrange="-2 2"/>
 <velocity joint="b" kv="80" ctrlrange="-1 1" damping="1.5"/>
 <position joint="c" kp="900" kv="30" gear="-1.5" forcerange="-40 60" armature=".2"/>
 <motor joint="d" gear="10" ctrlrange="-1 1" forcerange="-.7 .7"/>
 <general joint="e" gainprm="40" biastype="affine" biasprm="1 -25 -3" forcerange="-15 20"/>
 <velocity joint="f" kv="4" forcerange="-3 5" armature=".01" damping=".1"/>
 <motor joint="f" gear="-.5" armature=".02" damping=".3"/>
</actuator></mujoco>"""
)

SEVEN = (
    HEAD
    + """
<worldbody><body pos="0 .1 .3">
 <joint name="a" axis="0 0 1" armature=".4" damping="1"/><geom mass="4" pos=".01 .03 .05"/>
 <body pos=".02 0 .15" quat=".7071067811865476 .7071067811865476 0 0">
  <joint name="b" axis="0 0 -1" armature=".4" damping="1" ref=".5"/><geom mass="4" pos="0 .1 .02"/>
  <body pos="0 .2 .01" quat=".7 -.7 .1 .05">
   <joint name="c" axis="0 .1 1" pos="0 .02 0" damping=".5"/><geom mass="3" pos=".02 0 .1"/>
   <body pos="0 .02 .2" quat=".7071067811865476 0 .7071067811865476 0">
    <joint name="d" axis="0 1 0" armature=".2" damping=".5" ref="-1.5"/>
    <geom mass="2.5" pos=".1 0 0"/>
    <body pos=".2 .01 0" quat=".5 .5 .5 .5">
     <joint name="e" axis="1 0 0" damping=".2"/><geom mass="2" pos=".01 .05 .05"/>
     <body pos=".03 .1 .1" quat=".2 .1 .9 -.3">
      <joint name="f" axis=".6 0 .8" pos=".02 .02 0" armature=".05" damping=".1"/>
      <geom mass="1" pos="0 0 .06"/>
      <body pos="0 .03 .1" quat=".1 .9 .3 .3">
       <joint name="g" axis="0 -1 .4" damping=".1"/><geom mass=".7" pos=".01 .05 0"/>
       <body pos=".01 .1 0" quat=".4 .1 .2 .8"><geom mass=".2" pos="0 .03 .02"/>
        <body pos=".05 0 .02" quat=".9 .2 .2 0"><geom mass=".1" pos=".01 0 .02"/></body></body>
</body></body></body></body></body></body></body></worldbody>
<actuator>
 <position joint="a" kp="400" kv="40" forcerange="-87 87"/>
 <position joint="b" kp="400" kv="40" forcerange="-87 50"/>
 <position joint="c" kp="300" kv="30" forcerange="-60 87"/>
 <position joint="d" kp="300" kv="30" ctrlrange="-3 0"/>
 <velocity joint="e" kv="9" ctrlrange="-1 1" forcerange="-12 8"/>
 <motor joint="f" gear="-6"/>
 <general joint="g" gear="2" gainprm="5" biastype="affine" biasprm=".3 -4 -.5"/>
</actuator></mujoco>"""
)

ARMS = {"four": FOUR, "six": SIX, "seven": SEVEN}

INTEGRATORS = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}

QUICK = {"xla_backend_optimization_level": 0}
"""Compiler options for programs that run once: compiled in half the time."""


def load(arm: str, integrator: str = "euler") -> mujoco.MjModel:
    """A test arm with an integrator."""
    mj = mujoco.MjModel.from_xml_string(ARMS[arm])
    mj.opt.integrator = INTEGRATORS[integrator]
    return mj


def states(mj: mujoco.MjModel, count: int, seed: int) -> tuple[np.ndarray, ...]:
    """(count, nq) rad over the whole range, (count, nq) rad/s to 2, (count, nu) commands."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-np.pi, np.pi, (count, mj.nq))
    qd = rng.uniform(-2.0, 2.0, (count, mj.nq))
    # Every second row near the joint, so that about half of the actuators are within their limits.
    reach = np.where(np.arange(count)[:, None] % 2, 0.1, 2.0)
    joints = mj.actuator_trnid[:, 0]
    length = mj.actuator_gear[:, 0] * q[:, joints]
    target = np.where(mj.actuator_biasprm[:, 1] != 0.0, length, 0.0)
    return q, qd, target + reach * rng.uniform(-1.0, 1.0, (count, mj.nu))


def c_step(mj: mujoco.MjModel, q, qd, ctrl, d: mujoco.MjData | None = None) -> mujoco.MjData:
    """C MuJoCo's state after one step."""
    d = mujoco.MjData(mj) if d is None else d
    d.qpos[:], d.qvel[:], d.ctrl[:] = q, qd, ctrl
    mujoco.mj_step(mj, d)
    return d
