"""Per-episode model error: payload, wrist inertia, integrator."""

from dataclasses import replace

import jax
from flax import struct

from mcx_jax.arm.model import ChainModel, Link
from mcx_jax.spatial import add, mul, sub, vadd, vscale


@struct.dataclass
class Plant:
    """Scalars of one episode, unknown to the controller."""

    payload_kg: jax.Array
    """() point mass at the tool site."""
    wrist_inertia: jax.Array
    """() factor of the last link's rotational inertia about its centre of mass."""
    quiet: jax.Array
    """() 1 = quiet, 0 = Euler; read by the integrator `mixed` alone."""


def carried_by(model: ChainModel, plant: Plant | None) -> ChainModel:
    """The model with the plant's last link (its numbers are traced then, no longer constants)."""
    if plant is None:
        return model
    turned = _with_inertia(model.links[-1], plant.wrist_inertia)
    p = model.site_position
    loaded = replace(
        turned,
        mass=add(turned.mass, plant.payload_kg),
        moment=vadd(turned.moment, vscale(plant.payload_kg, p)),
        inertia=tuple(
            add(x, mul(plant.payload_kg, y))
            for x, y in zip(turned.inertia, _point_inertia(p), strict=True)
        ),
    )
    return replace(model, links=(*model.links[:-1], loaded))


def _with_inertia(link: Link, factor: jax.Array) -> Link:
    """The link with `factor` times its inertia about its own centre of mass."""
    centre = vscale(1.0 / link.mass, link.moment)
    steiner = [mul(link.mass, x) for x in _point_inertia(centre)]
    own = [sub(x, s) for x, s in zip(link.inertia, steiner, strict=True)]
    scaled = tuple(add(s, mul(factor, x)) for s, x in zip(steiner, own, strict=True))
    return replace(link, inertia=scaled)


def _point_inertia(p) -> tuple:
    """Inertia of 1 kg at p about the origin: xx, yy, zz, xy, xz, yz, m2."""
    x, y, z = p
    xx, yy, zz = mul(x, x), mul(y, y), mul(z, z)
    products = (-mul(x, y), -mul(x, z), -mul(y, z))
    return (add(yy, zz), add(xx, zz), add(xx, yy), *products)
