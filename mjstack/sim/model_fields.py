"""Model fields that may differ from world to world, and what native MuJoCo derives from them."""

from collections.abc import Callable, Iterable, Mapping

import mujoco
import numpy as np
from torch import Tensor

from mjstack.errors import MjstackError, UnknownName

# The float arrays that `mujoco_warp.put_model` batches, as of 4.0, by the first word of MuJoCo's
# names; a test compares them with the installed version. Left out: integers, which are the model's
# structure, and delays, which size the history buffers.
_NAMES = {
    "qpos0": "",
    "qpos": "spring",
    "body": "pos quat ipos iquat mass subtreemass inertia invweight0 gravcomp",
    "jnt": "solref solimp pos axis stiffness stiffnesspoly springyield range actfrcrange margin",
    "dof": "solref solimp frictionloss armature damping dampingpoly invweight0",
    "geom": (
        "solmix solref solimp size aabb rbound pos quat friction margin gap surfacevel adhesion"
        " rgba"
    ),
    "site": "pos quat",
    "cam": "pos quat poscom0 pos0 mat0 fovy intrinsic",
    "light": "pos dir poscom0 pos0 dir0 attenuation cutoff exponent ambient diffuse specular",
    "mat": "texrepeat emission specular shininess rgba",
    "pair": "solref solreffriction solimp margin gap adhesion friction",
    "eq": "solref solimp data",
    "tendon": (
        "solref_lim solimp_lim solref_fri solimp_fri range actfrcrange margin stiffness"
        " stiffnesspoly damping dampingpoly armature frictionloss lengthspring springyield length0"
        " invweight0"
    ),
    "actuator": (
        "cranklength dynprm gainprm biasprm actrange damping dampingpoly armature forcerange"
        " ctrlrange gear acc0 lengthrange"
    ),
}
REBOUND = (
    "{0} is a view of the simulation's memory and cannot be rebound: write {0}[:] = ... instead"
)
FIELD_NAMES = tuple(
    f"{first}_{rest}" if rest else first
    for first, words in _NAMES.items()
    for rest in words.split() or [""]
)

# Fields that place geoms: MJWarp places the ones that never move only once.
PLACING_FIELDS = frozenset({"body_pos", "body_quat", "geom_pos", "geom_quat"})


def check_fields(names: Iterable[str]) -> tuple[str, ...]:
    """The names, each once.

    Raises:
        UnknownName: A name is not a model field, or one that every world shares.
    """
    for name in names:
        if name not in FIELD_NAMES:
            first = name.partition("_")[0]
            alike = [known for known in FIELD_NAMES if known.partition("_")[0] == first]
            raise UnknownName("per-world model field", name, alike or FIELD_NAMES)
    return tuple(dict.fromkeys(names))


class Fields(dict[str, Tensor]):
    """Per-world model fields by MuJoCo's name. Write into a tensor; an item cannot be replaced."""

    def __missing__(self, name: str) -> Tensor:
        raise MjstackError(
            f"sim.fields['{name}'] is not a per-world field of this simulation: make it with"
            f" fields=['{name}'], or mark the reset term with uses_fields('{name}')"
        )

    def __setitem__(self, name: str, value: Tensor) -> None:
        # Python ends `fields[name] *= 2` by setting the item to the tensor that it has just changed
        # in place.
        if self[name] is not value:
            raise MjstackError(REBOUND.format(f"sim.fields['{name}']"))


SIMPLE_FIELDS = ("body_mass", "body_inertia", "dof_armature")


def simple_inertia(
    model: mujoco.MjModel, fields: Mapping[str, np.ndarray], dof_M0: np.ndarray
) -> Callable[[], None]:
    """A function that brings ``dof_M0`` of simple bodies up to date with per-world mass, inertia
    and armature.

    Native MuJoCo does not compute the mass matrix of a body that it calls simple, such as a free
    cube: it reads ``dof_M0``, which the compiler made from `SIMPLE_FIELDS`. A body whose mass is
    changed would weigh more and resist no more, so ``dof_M0`` has to follow: the diagonal of the
    mass matrix at qpos0 [kg, kg m2], shape ``(nworld, nv)``, which the function writes. ``fields``
    has every world's values of the fields that differ.
    """
    dofs = np.flatnonzero(model.dof_simplenum)
    bodies = model.dof_bodyid[dofs]
    mass, inertia, armature = (
        fields.get(name, getattr(model, name)[None]) for name in SIMPLE_FIELDS
    )
    # A simple body's inertial step is its own frame, so inertia is diagonal there: M0 =
    # armature + a * mass + b . inertia.
    joint = model.dof_jntid[dofs]
    kind = model.jnt_type[joint]
    number = dofs - model.jnt_dofadr[joint]  # of the degree of freedom in its joint
    axis = model.jnt_axis[joint]
    free = (kind == mujoco.mjtJoint.mjJNT_FREE) & (number < 3)
    slides = (kind == mujoco.mjtJoint.mjJNT_SLIDE) | free
    hinges = kind == mujoco.mjtJoint.mjJNT_HINGE
    lever = (np.cross(axis, model.jnt_pos[joint]) ** 2).sum(axis=1)
    a = np.where(hinges, lever, slides)
    b = np.where(hinges[:, None], axis**2, ~slides[:, None] * np.eye(3)[number % 3])

    def update() -> None:
        spin = (inertia[:, bodies] * b).sum(-1)
        dof_M0[:, dofs] = armature[:, dofs] + mass[:, bodies] * a + spin

    return update
