"""Model fields that may differ from world to world."""

from __future__ import annotations

from collections.abc import Iterable

from mjstack.errors import UnknownName

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
