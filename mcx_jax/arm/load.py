"""Which arms can do the task, and the posture in which their episodes begin."""

from mujoco import MjModel

from mcx_jax.arm.model import ChainModel, chain_model, load_mujoco
from mcx_jax.config.delay import PHYSICS_DT_S
from mcx_jax.errors import UserError
from mcx_jax.sea.spectrum import GRAVITY_M_S2

START_POSE_RAD = (-0.1, -1.0, 2.4, -2.9, -1.5, 0.0)
"""Where the first IK of an episode of a six-joint arm starts (authors' code)."""


def load_arm(name: str, tool_site: str) -> tuple[MjModel, ChainModel]:
    """An arm as MuJoCo and as the chain engine have it.

    Args:
        name: paper, ur10e, or an MJCF file.
        tool_site: name of the site that is the tool centre point E.

    Raises:
        UserError: there is no such arm, or it cannot do this task.
    """
    mj = load_mujoco(name)
    model = chain_model(mj, tool_site)
    _check(name, mj, model)
    return mj, model


def start_pose(model: ChainModel) -> tuple[float, ...]:
    """(nq,) rad: the UR10e's for six joints, else the middle of the ranges (0.3 without one)."""
    if model.nq == len(START_POSE_RAD):
        return START_POSE_RAD
    return tuple(0.5 * sum(link.q_range) if link.q_range[1] < 1e9 else 0.3 for link in model.links)


def _check(name: str, mj: MjModel, model: ChainModel) -> None:
    """Refuse an arm that cannot do this task."""
    if model.nq < 6:
        raise UserError(f"--arm {name}: it has {model.nq} joints; a full pose needs at least 6")
    if abs(model.timestep_s - PHYSICS_DT_S) > 1e-9:
        raise UserError(
            f"--arm {name}: its timestep is {model.timestep_s:g} s; set <option timestep="
            f'"{PHYSICS_DT_S}"/> (500 Hz physics)'
        )
    servos = [act.joint for act in model.actuators if act.bias[1]]
    if sorted(servos) != list(range(model.nq)):
        raise UserError(f"--arm {name}: every joint needs exactly one position servo actuator")
    if any(not act.bias[1] and not act.bias[2] for act in model.actuators):
        raise UserError(f"--arm {name}: torque motors are not driven here; use servo actuators")
    if any(act.gear != 1.0 or -act.gain not in act.bias[1:] for act in model.actuators):
        raise UserError(
            f"--arm {name}: a servo would not settle where it is told; use <position> and "
            "<velocity> actuators without gear"
        )
    down = (0.0, 0.0, -GRAVITY_M_S2)
    if max(abs(x - y) for x, y in zip(model.gravity, down, strict=True)) > 0.02:
        raise UserError(
            f"--arm {name}: its gravity is {' '.join(f'{x:g}' for x in model.gravity)}; at sea it "
            f"is 0 0 {down[2]:g} in the frame of the base, leave it out of the file"
        )
