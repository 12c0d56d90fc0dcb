"""Every field of MuJoCo's compiled model: read, refused, or without effect here and why.

One table for the chain engine, `mjx_step` and the task. A field of `mjModel` or `mjOption`
that is in none of its parts fails tests/test_fields.py by its name; so does one that changes a step
of C MuJoCo though it stands among those without effect. What the task refuses on top of it
(`envs.arm`) are values of fields that are read.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np

from mcx_jax.errors import UserError

Model = Any
"""A mujoco.MjModel, or a namespace of as many of its fields as an mjx.Model has."""

READ = {
    "size, tree and frames": """
        body_jntnum body_parentid body_pos body_quat jnt_axis jnt_bodyid jnt_dofadr jnt_pos
        jnt_qposadr nbody njnt nu qpos0
    """,
    "masses": "body_inertia body_ipos body_iquat body_mass dof_armature dof_damping",
    "limits, for the inverse kinematics alone": "jnt_limited jnt_range",
    "the tool": "name_siteadr names nsite site_bodyid site_pos site_quat",
    "servos": """
        actuator_armature actuator_biasprm actuator_biastype actuator_ctrllimited actuator_ctrlrange
        actuator_damping actuator_forcelimited actuator_forcerange actuator_gainprm actuator_gear
        actuator_trnid jnt_actuatorid
    """,
    "options": "opt.disableflags opt.gravity opt.integrator opt.timestep",
}
"""What `chain_model` and `mjx_model.read` make the arm of."""

WITHOUT_EFFECT = {
    "drawn, not simulated": """
        actuator_group cam_bodyid cam_fovy cam_intrinsic cam_ipd cam_mat0 cam_mode cam_output
        cam_pos cam_pos0 cam_poscom0 cam_projection cam_quat cam_resolution cam_sensorsize
        cam_targetbodyid cam_user geom_group geom_matid geom_rgba hfield_adr hfield_data hfield_ncol
        hfield_nrow hfield_pathadr hfield_size jnt_group light_active light_ambient
        light_attenuation light_bodyid light_bulbradius light_castshadow light_cutoff light_diffuse
        light_dir light_dir0 light_exponent light_intensity light_mode light_pos light_pos0
        light_poscom0 light_range light_softness light_specular light_targetbodyid light_texid
        light_type mat_emission mat_metallic mat_reflectance mat_rgba mat_roughness mat_shininess
        mat_specular mat_texid mat_texrepeat mat_texuniform mesh_bvhadr mesh_bvhnum mesh_extrema
        mesh_face mesh_faceadr mesh_facenormal mesh_facenum mesh_facetexcoord mesh_graph
        mesh_graphadr mesh_normal mesh_normaladr mesh_normalnum mesh_octadr mesh_octnum mesh_pathadr
        mesh_polyadr mesh_polymap mesh_polymapadr mesh_polymapnum mesh_polynormal mesh_polynum
        mesh_polyvert mesh_polyvertadr mesh_polyvertnum mesh_pos mesh_quat mesh_scale mesh_texcoord
        mesh_texcoordadr mesh_texcoordnum mesh_vert mesh_vertadr mesh_vertnum site_dataid site_group
        site_matid site_rgba site_size site_type skin_boneadr skin_bonebindpos skin_bonebindquat
        skin_bonebodyid skin_bonenum skin_bonevertadr skin_bonevertid skin_bonevertnum
        skin_bonevertweight skin_face skin_faceadr skin_facenum skin_group skin_inflate skin_matid
        skin_pathadr skin_rgba skin_texcoord skin_texcoordadr skin_vert skin_vertadr skin_vertnum
        tex_adr tex_colorspace tex_contenttypeadr tex_data tex_height tex_nchannel tex_pathadr
        tex_type tex_width vis
    """,
    "shapes, which the compiler has made masses of": """
        geom_dataid geom_pos geom_quat geom_size geom_type
    """,
    "contacts and limits, which are refused or disabled, and their solver": """
        dof_solimp dof_solref exclude_signature geom_adhesion geom_condim geom_friction geom_gap
        geom_margin geom_priority geom_solimp geom_solmix geom_solref geom_surfacevel jnt_margin
        jnt_solimp jnt_solref opt.ccd_iterations opt.ccd_tolerance opt.cone opt.impratio
        opt.iterations opt.jacobian opt.ls_iterations opt.ls_tolerance opt.noslip_iterations
        opt.noslip_tolerance opt.o_friction opt.o_margin opt.o_solimp opt.o_solref
        opt.sdf_initpoints opt.sdf_iterations opt.solver opt.tolerance pair_adhesion pair_dim
        pair_friction pair_gap pair_geom1 pair_geom2 pair_margin pair_signature pair_solimp
        pair_solref pair_solreffriction stat
    """,
    "equality constraints, tendons, flexes and plugins, which are refused or disabled": """
        efm0_dofid efm0_L efm0_L_colind efm0_L_rowadr efm0_L_rownnz efmC_perm eq_active0 eq_data
        eq_obj1id eq_obj2id eq_objtype eq_solimp eq_solref eq_type flex_activelayers flex_bending
        flex_bendingadr flex_bvhadr flex_bvhnum flex_cellnum flex_centered flex_conaffinity
        flex_condim flex_contype flex_damping flex_dim flex_edge flex_edgeadr flex_edgedamping
        flex_edgeequality flex_edgeflap flex_edgenum flex_edgestiffness flex_elem flex_elemadr
        flex_elemdataadr flex_elemedge flex_elemedgeadr flex_elemlayer flex_elemnum
        flex_elemtexcoord flex_flatskin flex_friction flex_gap flex_group flex_interp flex_margin
        flex_matid flex_node flex_node0 flex_nodeadr flex_nodebodyid flex_nodenum flex_passive
        flex_priority flex_radius flex_rgba flex_rigid flex_selfcollide flex_shell flex_shelldataadr
        flex_shellnum flex_size flex_solimp flex_solmix flex_solref flex_stiffness flex_stiffnessadr
        flex_texcoord flex_texcoordadr flex_vert flex_vert0 flex_vertadr flex_vertbodyid
        flex_vertedge flex_vertedgeadr flex_vertedgenum flex_vertmetric flex_vertnum
        flexedge_invweight0 flexedge_J_colind flexedge_J_rowadr flexedge_J_rownnz flexedge_length0
        flexedge_rigid flexvert_J_colind flexvert_J_rowadr flexvert_J_rownnz plugin plugin_attr
        plugin_attradr plugin_stateadr plugin_statenum ten_J_colind ten_J_rowadr ten_J_rownnz
        tendon_actfrclimited tendon_actfrcrange tendon_actuatorid tendon_adr tendon_armature
        tendon_damping tendon_dampingpoly tendon_frictionloss tendon_group tendon_invweight0
        tendon_length0 tendon_lengthspring tendon_limited tendon_margin tendon_matid tendon_num
        tendon_range tendon_rgba tendon_solimp_fri tendon_solimp_lim tendon_solref_fri
        tendon_solref_lim tendon_stiffness tendon_stiffnesspoly tendon_treeid tendon_treenum
        tendon_user tendon_width wrap_objid wrap_prm wrap_type
    """,
    "fluids, which are refused": "geom_fluid opt.wind",
    "more of what is refused: activations, springs, gravity compensation, sleep": """
        actuator_actearly actuator_actlimited actuator_actrange actuator_cranklength actuator_dynprm
        jnt_actfrcrange jnt_actgravcomp opt.sleep_tolerance qpos_spring tree_sleep_policy
    """,
    "sensors, keyframes, the user's own numbers: nothing moves by them": """
        actuator_user body_user geom_user jnt_user key_act key_ctrl key_mpos key_mquat key_qpos
        key_qvel key_time numeric_adr numeric_data numeric_size opt.magnetic sensor_adr
        sensor_cutoff sensor_datatype sensor_delay sensor_dim sensor_history sensor_historyadr
        sensor_interval sensor_intprm sensor_needstage sensor_noise sensor_objid sensor_objtype
        sensor_plugin sensor_refid sensor_reftype sensor_type sensor_user site_user text_adr
        text_data text_size tuple_adr tuple_objid tuple_objprm tuple_objtype tuple_size
    """,
}
"""What moves nothing here, and why. A test changes each and looks at C MuJoCo's step."""

DERIVED = {
    "of masses and frames at the reference pose": """
        actuator_acc0 actuator_length0 actuator_lengthrange body_invweight0 body_subtreemass
        dof_invweight0 dof_length dof_M0
    """,
    "what MuJoCo takes short cuts by": """
        body_conaffinity body_contype body_margin body_sameframe body_simple dof_simplenum
        flg_adhesion flg_gravcomp flg_surfacevel geom_aabb geom_rbound geom_sameframe ngravcomp
        site_sameframe
    """,
}
"""What the compiler has made of the fields above; not read, but made again."""

LAYOUT = {
    "sizes": """
        nactuator narena nB nbuffer nbvh nbvhdynamic nbvhstatic nC ncam nconmax nD nefm0dof nefm0L
        nefmCvert nemax nexclude nflexbending nflexedge nflexelem nflexelemdata nflexelemedge
        nflexnode nflexshelldata nflexstiffness nflextexcoord nflexvert ngeom nhfield nhfielddata
        nhistory nJfe nJfv njmax nJmom nJten nkey nlight nM nmat nmesh nmeshdegmax nmeshface
        nmeshgraph nmeshnormal nmeshpoly nmeshpolymap nmeshpolyvert nmeshtexcoord nmeshvert nnames
        nnames_map nnumeric nnumericdata noct nout npaths npluginattr npluginstate npolygonmax nq
        nsensor nsensordata nskin nskinbone nskinbonevert nskinface nskintexvert nskinvert ntex
        ntexdata ntext ntextdata ntree ntuple ntupledata nuser_actuator nuser_body nuser_cam
        nuser_geom nuser_jnt nuser_sensor nuser_site nuser_tendon nuserdata nv nwrap
    """,
    "names and paths": """
        name_actuatoradr name_bodyadr name_camadr name_eqadr name_excludeadr name_flexadr
        name_geomadr name_hfieldadr name_jntadr name_keyadr name_lightadr name_matadr name_meshadr
        name_numericadr name_pairadr name_pluginadr name_sensoradr name_skinadr name_tendonadr
        name_texadr name_textadr name_tupleadr names_map paths
    """,
    "addresses and ids: which belongs to which": """
        actuator_actadr actuator_actnum actuator_ctrladr actuator_historyadr actuator_outadr
        actuator_plugin body_bvhadr body_bvhnum body_dofadr body_dofnum body_geomadr body_geomnum
        body_jntadr body_mocapid body_plugin body_rootid body_treeid body_weldid dof_bodyid
        dof_jntid dof_Madr dof_parentid dof_treeid geom_bodyid geom_plugin signature
        tree_bodyadr tree_bodynum tree_dofadr tree_dofnum
    """,
    "of an actuator with fixed gain on a joint: one input, one output": """
        actuator_ctrlnum actuator_ctrlspec actuator_outnum
    """,
    "the buffer of a delay, which is refused (without a delay nobody reads it)": "actuator_history",
    "sparse matrices, trees of bounding boxes": """
        B_colind B_rowadr B_rownnz bvh_aabb bvh_child bvh_depth bvh_nodeid D_colind D_diag D_rowadr
        D_rownnz M_colind M_rowadr M_rownnz mapD2M mapM2D mapM2M oct_aabb oct_child oct_coeff
        oct_depth
    """,
}
"""Where the fields lie in memory."""
_LARGEST = float(np.finfo(np.float32).max)
_OFF = mujoco.mjtDisableBit
_INTEGRATORS = {
    int(mujoco.mjtIntegrator.mjINT_EULER): "euler",
    int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST): "implicitfast",
}
_HARMLESS = (
    mujoco.mjtEnableBit.mjENBL_OVERRIDE,  # of contacts
    mujoco.mjtEnableBit.mjENBL_ENERGY,
    mujoco.mjtEnableBit.mjENBL_FWDINV,
    mujoco.mjtEnableBit.mjENBL_INVDISCRETE,
    mujoco.mjtEnableBit.mjENBL_DIAGEXACT,  # of constraints
)
"""Enabled features that move nothing."""
_KNOWN_OFF = int(_OFF.mjDSBL_MULTICCD) * 2 - 1
"""All disabled features that there are; the last one's bit and all below."""


class Refusal(NamedTuple):
    """What the chain engine does not model."""

    fault: str
    """What the model has; a row of docs/own-arm.md."""
    fields: str
    """Those that bring it."""
    found: Callable[[Model], Any]
    """Of a model: false where it has none; a text says more."""


def _any(*names: str) -> Callable[[Model], bool]:
    """Whether one of some fields is not zero."""
    return lambda m: any(bool(np.any(value(m, name))) for name in names)


def _differ(name: str, *allowed: int) -> Callable[[Model], bool]:
    """Whether a field has other values than those."""
    return lambda m: not bool(np.all(np.isin(value(m, name), allowed)))


def _constrained(m: Model, kind: int = 0) -> bool:
    """Whether constraints (of a kind) are on."""
    return not int(m.opt.disableflags) & (_OFF.mjDSBL_CONSTRAINT | kind)


def _not_finite(m: Model) -> str:
    wrong = [
        name
        for name, x in fields_of(m).items()
        if np.asarray(x).dtype.kind == "f" and not np.all(np.abs(x) <= _LARGEST)
    ]
    derived = {name for names in DERIVED.values() for name in names.split()}
    return ", ".join([name for name in wrong if name not in derived] or wrong)


def _branches(m: Model) -> bool:
    carriers = [moving_ancestor(m, int(b)) for b in m.jnt_bodyid]
    return carriers != [0, *(int(b) for b in m.jnt_bodyid[:-1])]


def _contacts(m: Model) -> bool:
    collidable = bool(np.any(m.geom_contype[:, None] & m.geom_conaffinity[None, :]))
    return _constrained(m, _OFF.mjDSBL_CONTACT) and (collidable or m.npair > 0)


def _integrator(m: Model) -> str:
    number = int(m.opt.integrator)
    if number in _INTEGRATORS:
        return ""
    return mujoco.mjtIntegrator(number).name.removeprefix("mjINT_").lower()


def _disabled_groups(m: Model) -> bool:
    return any(int(m.opt.disableactuator) >> int(g) & 1 for g in m.actuator_group if 0 <= g < 31)


def _features(m: Model) -> str:
    enabled = int(m.opt.enableflags) & ~sum(int(bit) for bit in _HARMLESS)
    disabled = int(m.opt.disableflags) & ~_KNOWN_OFF
    return ", ".join(
        f"{flags} bit {bit}"
        for flags, bits in (("enableflags", enabled), ("disableflags", disabled))
        for bit in range(bits.bit_length())
        if bits >> bit & 1
    )


REFUSED = (
    Refusal("numbers that are not finite", "", _not_finite),
    Refusal("no joints", "njnt", lambda m: m.njnt == 0),
    Refusal(
        "joints that are not hinges", "jnt_type", _differ("jnt_type", mujoco.mjtJoint.mjJNT_HINGE)
    ),
    Refusal(
        "more than one joint on a body",
        "jnt_bodyid",
        lambda m: len(set(m.jnt_bodyid.tolist())) < m.njnt,
    ),
    Refusal("a branching (not serial) tree", "body_parentid", _branches),
    Refusal(
        'contacts (disable them with <flag contact="disable"/>)',
        "geom_contype geom_conaffinity npair",
        _contacts,
    ),
    Refusal(
        'active joint limits (disable them with <flag limit="disable"/>)',
        "jnt_limited",
        lambda m: _constrained(m, _OFF.mjDSBL_LIMIT) and np.any(m.jnt_limited),
    ),
    Refusal("equality constraints", "neq", lambda m: _constrained(m) and m.neq > 0),
    Refusal(
        "dry joint friction (frictionloss)",
        "dof_frictionloss",
        lambda m: _constrained(m) and np.any(m.dof_frictionloss),
    ),
    Refusal(
        "joint springs (stiffness)",
        "jnt_stiffness jnt_stiffnesspoly",
        _any("jnt_stiffness", "jnt_stiffnesspoly"),
    ),
    Refusal(
        "non-linear joint damping",
        "dof_dampingpoly actuator_dampingpoly",
        _any("dof_dampingpoly", "actuator_dampingpoly"),
    ),
    Refusal(
        "disabled dampers, actuation or implicit damping",
        "opt.disableflags",
        lambda m: (
            int(m.opt.disableflags)
            & (_OFF.mjDSBL_DAMPER | _OFF.mjDSBL_ACTUATION | _OFF.mjDSBL_EULERDAMP)
        ),
    ),
    Refusal("gravity compensation", "body_gravcomp", _any("body_gravcomp")),
    Refusal("joint-level actuator force limits", "jnt_actfrclimited", _any("jnt_actfrclimited")),
    Refusal("tendons", "ntendon", _any("ntendon")),
    Refusal("fluid forces", "opt.density opt.viscosity", _any("opt.density", "opt.viscosity")),
    Refusal("mocap bodies", "nmocap", _any("nmocap")),
    Refusal("deformable bodies (flex)", "nflex", _any("nflex")),
    Refusal("plugins", "nplugin", _any("nplugin")),
    Refusal(
        "actuators that do not act on a joint",
        "actuator_trntype",
        _differ("actuator_trntype", mujoco.mjtTrn.mjTRN_JOINT),
    ),
    Refusal(
        "delayed actuators (give the lateness as --delay)", "actuator_delay", _any("actuator_delay")
    ),
    Refusal(
        "actuators with internal dynamics", "na actuator_dyntype", _any("na", "actuator_dyntype")
    ),
    Refusal(
        "actuators with a gain or bias that is not constant/affine",
        "actuator_gaintype actuator_biastype",
        lambda m: (
            _differ("actuator_gaintype", mujoco.mjtGain.mjGAIN_FIXED)(m)
            or _differ(
                "actuator_biastype", mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE
            )(m)
        ),
    ),
    Refusal("disabled groups of actuators", "opt.disableactuator", _disabled_groups),
    Refusal(
        "an integrator other than Euler or implicitfast (set one of them in <option>; --integrator "
        "chooses another for a run)",
        "opt.integrator",
        _integrator,
    ),
    Refusal("sleeping bodies or a feature not known here", "opt.enableflags", _features),
)
"""In the order in which they are looked for."""


def refuse_unsupported(mj: Model) -> None:
    """Raise a UserError naming the first thing that the chain engine does not model."""
    for fault, _, found in REFUSED:
        if here := found(mj):
            more = f": {here}" if isinstance(here, str) else ""
            raise UserError(
                f"the chain engine cannot take this arm model: it has {fault}{more}; "
                "take that out of the MJCF file"
            )


def integrator(mj: Model) -> str:
    """euler or implicitfast, of a model that is not refused."""
    return _INTEGRATORS[int(mj.opt.integrator)]


def fields_of(mj: Model) -> dict[str, Any]:
    """All fields of a model by name, those of its options as `opt.NAME`."""
    found = {}
    for prefix, holder in (("", mj), ("opt.", mj.opt)):
        for name in dir(holder):
            field = None if name.startswith("_") else getattr(holder, name)
            if field is not None and field is not mj.opt and not callable(field):
                found[prefix + name] = field
    return found


def value(mj: Model, name: str) -> Any:
    """What a model has in a field."""
    return getattr(mj.opt, name[4:]) if name.startswith("opt.") else getattr(mj, name)


def moving_ancestor(mj: Model, body: int) -> int:
    """The nearest ancestor with a joint, or 0 (the world)."""
    body = int(mj.body_parentid[body])
    while body and mj.body_jntnum[body] == 0:
        body = int(mj.body_parentid[body])
    return body
