"""The arms and hands of an MJCF file: which joints are an arm's, and which its gripper's."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from mjstack.robots.bodies import ancestors, subtree
from mjstack.robots.posture import actuator_moment

_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)  # hinges follow; others are not an arm's
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_JOINT_OR_TENDON = [
    int(getattr(mujoco.mjtTrn, f"mjTRN_{kind}")) for kind in ("JOINT", "JOINTINPARENT", "TENDON")
]
_BASE = 0.4  # m: a geom of the world that is all so near an arm is its base
_FINGER = 3  # joints with a servo that a finger has at most; an arm has more


@dataclass(frozen=True)
class Hand:
    """A gripper at the end of an arm: indices of a compiled model.

    Attributes:
        palm: The last body that carries both jaws; of a one-finger jaw, the fixed jaw.
        arm: Joints from the base to the palm, in order.
        gripper: Joints of the gripper that a servo moves, or that no other joint moves.
        bodies: The moving bodies beyond the palm.
        one_finger: Whether the palm is one of the jaws.
        outside: Joints between the world and the arm: of a base that drives or floats, or that
            carry another arm too.
    """

    palm: int
    arm: tuple[int, ...]
    gripper: tuple[int, ...]
    bodies: tuple[int, ...]
    one_finger: bool
    outside: tuple[int, ...]


def find_hands(model: mujoco.MjModel) -> list[Hand]:
    """All hands of a model, in the file's order; those on a base that floats only if no other
    is there.
    """
    driven = _driven(model)
    subtrees = [subtree(model, body) for body in range(model.nbody)]
    jointed = {int(body) for body in model.jnt_bodyid}

    def branches(body: int) -> list[list[int]]:
        """Subtrees with joints that begin at a body's children."""
        children = np.flatnonzero(model.body_parentid == body)
        return [subtrees[c] for c in children if c != 0 and jointed & {*subtrees[c]}]

    def is_palm(body: int) -> bool:
        fingers = branches(body)
        counts = [len(driven & {*_joints(model, bodies)}) for bodies in fingers]
        return body != 0 and len(fingers) > 1 and max(counts) <= _FINGER and any(counts)

    palms = [b for b in range(model.nbody) if is_palm(b)]
    palms = [b for b in palms if not any(p != b and p in subtrees[b] for p in palms)]
    hands = [
        _hand(model, palm, [b for sub in branches(palm) for b in sub], driven) for palm in palms
    ]
    gripping = {b for palm in palms for b in subtrees[palm]}
    leaves = [b for b in jointed if not any(b != j and j in subtrees[b] for j in jointed)]
    for leaf in leaves:  # a jaw against the body that carries it
        if leaf not in gripping and model.body_jntnum[leaf] == 1:
            palm = int(model.body_parentid[leaf])
            hands.append(_hand(model, palm, subtrees[leaf], driven, one_finger=True))
    hands = [hand for hand in hands if len(hand.arm) > 1 and hand.gripper]
    hands.sort(key=lambda hand: hand.palm)
    fixed = [h for h in hands if all(model.jnt_type[j] != _FREE for j in h.outside)]
    return fixed or hands


def _hand(
    model: mujoco.MjModel,
    palm: int,
    bodies: list[int],
    driven: set[int],
    *,
    one_finger: bool = False,
) -> Hand:
    path = _joints(model, [*ancestors(model, palm)])
    unbounded = (model.jnt_type < _SLIDE) | (model.jnt_type == _SLIDE) & (model.jnt_limited == 0)
    siblings = driven - {*path, *_joints(model, bodies)}
    carriers = {body for j in siblings for body in ancestors(model, model.jnt_bodyid[j])}
    bases = {*model.jnt_bodyid[[j for j in path if unbounded[j]]].tolist()} | carriers
    last = max((path.index(j) for j in path if model.jnt_bodyid[j] in bases), default=-1)
    joints = [j for j in _joints(model, bodies) if model.jnt_type[j] >= _SLIDE]
    fingers = [j for j in joints if j in driven] or joints
    return Hand(
        palm, tuple(path[last + 1 :]), tuple(fingers), tuple(bodies), one_finger,
        tuple(path[: last + 1]),
    )  # fmt: skip


def _driven(model: mujoco.MjModel) -> set[int]:
    """Joints with an actuator, also by a tendon; where a hand or arm has none, each that no
    equality ties to another.
    """
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    moved = actuator_moment(data)[np.isin(model.actuator_trntype, _JOINT_OR_TENDON)] != 0.0
    driven = {*model.dof_jntid[moved.any(axis=0)].tolist()}
    joint = int(mujoco.mjtEq.mjEQ_JOINT)
    ties = zip(model.eq_type, model.eq_obj1id, model.eq_obj2id, strict=True)
    followers = {int(follower) for kind, follower, leader in ties if kind == joint and leader >= 0}
    trees = [model.body_rootid[body] for body in model.jnt_bodyid]
    with_servos = {trees[j] for j in driven}
    bare = {j for j, tree in enumerate(trees) if tree not in with_servos}
    return {j for j in driven | (bare - followers) if model.jnt_type[j] >= _SLIDE}


def _joints(model: mujoco.MjModel, bodies: Sequence[int]) -> list[int]:
    """Joints of some bodies, in order."""
    joints: list[int] = np.flatnonzero(np.isin(model.jnt_bodyid, bodies)).tolist()
    return joints


def find_root(model: mujoco.MjModel, hand: Hand) -> int:
    """The highest body at and below which no joint but the hand's and its arm's has a servo or
    carries the arm; 0, for the whole file, if there is nothing else in it than what a scene leaves
    out by itself, and the arm's base.
    """
    siblings = {*hand.outside} | _driven(model) - {*hand.arm, *_joints(model, hand.bodies)}
    path = [*reversed([*ancestors(model, hand.palm)])]
    root = next(b for b in path if siblings.isdisjoint(_joints(model, subtree(model, b))))
    tops = np.flatnonzero(model.body_parentid == 0)[1:]
    free = {t for t in tops if _FREE in model.jnt_type[_joints(model, [t])]}
    plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    here = np.flatnonzero((model.geom_bodyid == 0) & ~plane)
    far = np.linalg.norm(model.geom_pos[here] - model.body_pos[path[0]], axis=1)
    large = (far + model.geom_rbound[here] > _BASE).any()
    return 0 if root == path[0] and {*tops} <= {root, *free} and not large else root
