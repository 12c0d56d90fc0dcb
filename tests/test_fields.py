"""Every field of MuJoCo's compiled model is read, refused, or moves nothing: changed one by one.

An arm with everything that a model file can have besides what is refused; of each field that is
changed the chain engine must refuse the model or follow C MuJoCo's step, and C must not move
another way by a field that the table has among those without effect.
"""

import copy
import dataclasses
import functools
import itertools
import math

import arms
import jax
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mcx_jax.arm import chain, dynamics, fields, mjx_engine
from mcx_jax.arm.model import chain_model
from mcx_jax.errors import UserError
from mcx_jax.integrations.mjx_model import read
from mcx_jax.integrations.mjx_step import put_model

PARTS = {
    "read": fields.READ,
    "refused": {x.fault: x.fields for x in fields.REFUSED},
    "without effect": fields.WITHOUT_EFFECT,
    "derived": fields.DERIVED,
    "layout": fields.LAYOUT,
}
ROLES = {
    part: {name for names in table.values() for name in names.split()}
    for part, table in PARTS.items()
}
NO_FORCE = {"jnt_limited", "jnt_range", "site_pos", "site_quat"}
"""Read for the inverse kinematics and the tool: nothing moves by them."""
F64 = 1e-9
"""rad/s, as tests/test_arms.py."""

FURNITURE = """<asset><texture name="t" type="2d" builtin="checker" width="4" height="4"/>
<material name="m" texture="t"/><mesh name="v" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>
<hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/></asset>
<custom><numeric name="n" data="1 2"/><text name="x" data="y"/>
<tuple name="u"><element objtype="body" objname="last"/></tuple></custom>
<contact><exclude body1="first" body2="last"/></contact>
<sensor><jointpos joint="a" delay=".01" nsample="3" noise=".1" cutoff="1"/>
<framepos objtype="site" objname="tool"/><touch site="tool"/><magnetometer site="tool"/></sensor>
<keyframe><key qpos="1 1 1 1 1 1"/></keyframe><size nuser_body="1" nuser_jnt="1" nuser_geom="1"
 nuser_site="1" nuser_actuator="1" nuser_sensor="1"/>
"""
SEEN = """<camera mode="targetbodycom" target="first"/><light mode="trackcom"/>
<site name="tool" pos=".1 0 0"/><geom name="y" type="mesh" mesh="v" mass=".1" material="m"/>"""


def furnished() -> str:
    """The arm `six`, constraints on, with all that a scene may have."""
    xml = arms.SIX.replace('<flag contact="disable" constraint="disable"/>', "")
    xml = xml.replace("<geom type=", '<geom contype="0" conaffinity="0" type=')
    xml = xml.replace('<body pos="0 0 .2"', '<body name="first" pos="0 0 .2"')
    xml = xml.replace('<body pos=".03 0 .1"', f'{SEEN}<body name="last" pos=".03 0 .1"')
    xml = xml.replace("<worldbody>", '<worldbody><geom name="x" size=".1 .1 .1"/>')
    xml = xml.replace("<actuator>", f"{FURNITURE}<actuator>")
    return xml


XML = furnished()


@pytest.fixture(scope="module")
def arm():
    mj = mujoco.MjModel.from_xml_string(XML)
    # C's short cuts, made by the compiler, would hide some of the changes below from it.
    mj.body_sameframe[:] = mj.body_simple[:] = mj.dof_simplenum[:] = 0
    return mj


@pytest.fixture(scope="module")
def arm_without_sensors():
    """Of a delay an mjx.Model keeps only the buffer's size, be it a sensor's."""
    return mujoco.MjModel.from_xml_string(XML.replace('delay=".01" nsample="3"', ""))


def changed(mj: mujoco.MjModel, name: str) -> mujoco.MjModel:
    """A copy with other numbers in a field."""
    mj = copy.copy(mj)
    rng = np.random.default_rng(5)
    old = np.asarray(fields.value(mj, name))
    if old.dtype.kind == "f":
        factor = rng.uniform(0.4, 0.9, old.shape)
        new = np.where(old == 0, 0.1 * factor, old * factor)
        if "quat" in name or name == "jnt_axis":
            new /= np.linalg.norm(new, axis=-1, keepdims=True)
    else:
        new = ~old if old.dtype.kind == "b" else old + 1
    if old.shape:
        fields.value(mj, name)[:] = new
    else:
        setattr(mj.opt, name.removeprefix("opt."), new.item())
    return mj


def settable(mj: mujoco.MjModel) -> list[str]:
    """Fields that can be changed one by one: real numbers, and of the integers those that are not
    addresses, which would take C out of its memory."""
    found = []
    for name in sorted(ROLES["read"] | ROLES["refused"] | ROLES["without effect"]):
        old = np.asarray(fields.value(mj, name))
        counts = old.dtype.kind in "iu" and (
            name.startswith(("opt.", "actuator_", "geom_", "tree_"))
            and name != "actuator_trnid"
            and not name.endswith("flags")
        )
        if old.size and (old.dtype.kind in "fb" or counts):
            found.append(name)
    return found


def c_steps(mj: mujoco.MjModel) -> np.ndarray:
    """(rows, nq) velocities after a step of C MuJoCo, within and beyond the limits of servos."""
    return np.stack([arms.c_step(mj, *row).qvel for row in rows()])


@functools.cache
def rows() -> list[tuple[np.ndarray, ...]]:
    """States of the arm as it is before a field is changed."""
    return list(zip(*arms.states(arms.load("six"), 2, seed=1), strict=True))


@pytest.fixture
def chain_steps(monkeypatch):
    """`c_steps` of the chain engine in Python floats: 100 times faster than JAX uncompiled, and
    no two of these models share a compiled program."""
    monkeypatch.setattr(dynamics, "sincos", lambda x: (math.sin(x), math.cos(x)))
    monkeypatch.setattr(chain, "jnp", np)
    monkeypatch.setattr(chain, "joint_accelerations", lambda *x: chain._accelerations(*x)[0])

    def steps(mj):
        model = chain_model(mj)
        x, y, z = model.gravity
        still = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (-x, -y, -z))
        floats = [[list(map(float, x)) for x in row] for row in rows()]
        name = model.integrator
        return np.array([chain.substep(model, name, *row, base=still)[1] for row in floats])

    return steps


def test_a_field_that_mujoco_brings_anew_is_in_no_part_of_the_table(arm):
    here = set(fields.fields_of(arm))
    known = set().union(*ROLES.values())
    assert here - known == set(), "new in this MuJoCo: put it in mcx_jax/arm/fields.py"
    assert known - here == set(), "gone from this MuJoCo"


def test_only_what_is_read_may_be_in_two_parts():
    for part, names in ROLES.items():
        for other, theirs in ROLES.items():
            if part < other:
                assert not names & theirs or {part, other} == {"read", "refused"}, (part, other)


def test_each_field_is_refused_or_followed_or_without_effect(arm, chain_steps):
    before = c_steps(arm)
    np.testing.assert_allclose(chain_steps(arm), before, rtol=0, atol=F64)
    names = settable(arm)
    assert len(names) > 100
    moved, refused = set(), set()
    for name in names:
        other = changed(arm, name)
        try:
            chain_model(other)
        except UserError:
            refused.add(name)
            continue
        after = c_steps(other)
        if np.array_equal(after, before):
            continue
        moved.add(name)
        assert name in ROLES["read"], f"{name} changes C MuJoCo's step and is not read"
        np.testing.assert_allclose(chain_steps(other), after, rtol=0, atol=F64, err_msg=name)
    assert refused <= ROLES["refused"] | ROLES["read"]
    both_needed = {"geom_contype", "geom_conaffinity"}
    assert ROLES["refused"] & set(names) <= refused | moved | both_needed
    real = (ROLES["read"] & set(names)) - refused - NO_FORCE
    assert moved == real


@pytest.mark.parametrize("kind", ["disableflags", "enableflags"])
def test_each_flag_is_refused_or_followed(arm, chain_steps, kind):
    """One bit more than MuJoCo has today included."""
    for bit in range(22):
        other = copy.copy(arm)
        setattr(other.opt, kind, getattr(other.opt, kind) ^ 1 << bit)
        try:
            chain_model(other)
        except UserError:
            continue
        np.testing.assert_allclose(chain_steps(other), c_steps(other), rtol=0, atol=F64)
        assert bit <= 20, "not known here and not refused"


class Changed:
    """A model in which a size, which cannot be set, is another."""

    def __init__(self, mj, **other):
        self.mj, self.other = mj, other

    def __getattr__(self, name):
        return self.other[name] if name in self.other else getattr(self.mj, name)

    def __dir__(self):
        return dir(self.mj)


def test_each_size_that_brings_forces_is_refused(arm):
    brought = {
        name: refusal.fault
        for refusal in fields.REFUSED
        for name in refusal.fields.split()
        if not np.shape(fields.value(arm, name)) and not name.startswith("opt.") and name != "njnt"
    }
    assert set(brought) >= {"npair", "neq", "ntendon", "nflex", "nmocap", "nplugin", "na"}
    for name, fault in brought.items():
        with pytest.raises(UserError) as error:
            fields.refuse_unsupported(Changed(arm, **{name: 1}))
        assert fault in str(error.value)
    with pytest.raises(UserError, match="no joints"):
        fields.refuse_unsupported(Changed(arm, njnt=0))


BROUGHT = {
    "delayed actuators (give the lateness as --delay)": (
        "<motor",
        '<motor delay=".04" nsample="9"',
    ),
    "non-linear joint damping": ("<motor", '<motor damping="0 1"'),
    "disabled groups of actuators": ("<option", '<option actuatorgroupdisable="0"'),
    "contacts": ("<exclude", '<pair geom1="x" geom2="y"/><exclude'),
    "Euler or implicitfast": ("<option", '<option integrator="discrete"'),
    ": discrete; ": ("<option", '<option integrator="discrete"'),
    ": rk4; ": ("<option", '<option integrator="RK4"'),
    "enableflags bit 4": ("<worldbody>", '<option><flag sleep="enable"/></option><worldbody>'),
    "body_mass": ('mass="6"', 'mass="inf"'),
}


@pytest.mark.parametrize("said", BROUGHT)
def test_what_mujoco_has_brought_lately_is_refused_by_its_name(said):
    xml = XML.replace(*BROUGHT[said], 1)
    with pytest.raises(UserError) as error:
        chain_model(mujoco.MjModel.from_xml_string(xml))
    assert said in str(error.value) and "\n" not in str(error.value)


def test_a_number_that_is_not_finite_is_refused_by_its_field(arm):
    """Nor one beyond float32, in which the engine computes."""
    numbers = itertools.cycle([np.inf, np.nan, 1e39])
    for name, old in fields.fields_of(arm).items():
        if np.asarray(old).dtype.kind != "f" or not np.size(old):
            continue
        other, number = copy.copy(arm), next(numbers)
        if np.asarray(old).dtype == np.float32:
            number = np.inf
        if np.shape(old):
            fields.value(other, name)[(-1,) * np.ndim(old)] = number
        else:
            setattr(other.opt, name.removeprefix("opt."), number)
        with pytest.raises(UserError, match=f"not finite: {name}; take"):
            fields.refuse_unsupported(other)


def test_mjx_has_every_field_that_is_read_or_refused_but_those_that_put_model_sees_to():
    there = {f.name for f in dataclasses.fields(mjx.Model)}
    there |= {f"opt.{f.name}" for f in dataclasses.fields(mjx.Option)}
    needed = ROLES["read"] | ROLES["refused"]
    armature = {"actuator_armature", "actuator_damping", "jnt_actuatorid"}
    elsewhere = {
        "actuator_delay",  # nhistory
        "nplugin",  # npluginstate
        "opt.disableactuator",  # in _impl
        "actuator_dampingpoly",  # dropped
    }
    assert needed - there == armature | elsewhere
    new = there - set().union(*ROLES.values())
    assert new == {"opt", "_sizes", "_impl", "opt._impl"}, "new in this MJX"


def test_mjx_step_reads_what_the_chain_engine_reads(arm_without_sensors):
    """Of an arm in which all that is read is changed."""
    mj = arm = arm_without_sensors
    for name in sorted(ROLES["read"] & set(settable(arm)) - NO_FORCE - FLAGS):
        mj = changed(mj, name)
    with jax.enable_x64(True):
        got = read(put_model(mj))
    want, before = chain_model(mj), chain_model(arm)
    parts = ("rotation", "position", "mass", "moment", "inertia", "armature", "damping", "q_ref")
    for part in parts:
        mine, theirs, old = (
            np.array([getattr(link, part) for link in links])
            for links in (got.model.links, want.links, before.links)
        )
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-12, err_msg=part)  # summed anew
        assert not np.allclose(theirs, old), part
    for mine, theirs in zip(got.actuators, want.actuators, strict=True):
        assert vars(mine) == dataclasses.asdict(theirs)
    assert (got.timestep_s, got.gravity) == (want.timestep_s, want.gravity)
    engine = mjx_engine.put_model(mj, "euler")
    np.testing.assert_allclose(engine.dof_armature, [x.armature for x in want.links], rtol=1e-6)
    np.testing.assert_allclose(engine.dof_damping, [x.damping for x in want.links], rtol=1e-6)


FLAGS = {"actuator_biastype", "actuator_ctrllimited", "actuator_forcelimited", "opt.integrator"}


def test_armature_that_mjx_dropped_is_refused_where_it_can_be_seen(arm_without_sensors):
    delayed = XML.replace("<motor", '<motor delay=".04" nsample="9"')
    with pytest.raises(
        UserError, match="put the model with mcx_jax.integrations.mjx_step.put_model"
    ):
        read(mjx.put_model(arm_without_sensors))
    with pytest.raises(UserError, match="delayed actuators or sensors"):
        read(mjx.put_model(mujoco.MjModel.from_xml_string(delayed)))


@pytest.mark.parametrize("put", [put_model, lambda mj: mjx_engine.put_model(mj, "euler")])
def test_what_mjx_lacks_is_a_line(put):
    xml = XML.replace("<worldbody>", '<option><flag energy="enable"/></option><worldbody>')
    mj = mujoco.MjModel.from_xml_string(xml)
    chain_model(mj)
    with pytest.raises(UserError, match="MJX cannot take this arm model: mjtEnableBit.*ENERGY"):
        put(mj)
