"""Warp kernel that places the geoms of bodies that never move."""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
import warp as wp


@wp.kernel(enable_backward=False)
def place_static_geoms(
    body_rootid: wp.array[int],
    body_weldid: wp.array[int],
    body_mocapid: wp.array[int],
    geom_bodyid: wp.array[int],
    geom_pos: wp.array2d[wp.vec3],
    geom_quat: wp.array2d[wp.quat],
    xpos: wp.array2d[wp.vec3],
    xquat: wp.array2d[wp.quat],
    geom_xpos: wp.array2d[wp.vec3],
    geom_xmat: wp.array2d[wp.mat33],
) -> None:
    """Write the poses of exactly those geoms that MJWarp's kinematics leaves out. Warp's own
    quaternions are xyzw.
    """
    world, geom = wp.tid()  # type: ignore[misc]
    body = geom_bodyid[geom]
    if body_weldid[body] != 0 or body_mocapid[body_rootid[body]] != -1:
        return
    # Fields that the worlds share have one row.
    p = geom_pos[world % geom_pos.shape[0], geom]
    g = geom_quat[world % geom_quat.shape[0], geom]
    b = xquat[world, body]
    q = wp.quat(b[1], b[2], b[3], b[0])
    geom_xpos[world, geom] = xpos[world, body] + wp.quat_rotate(q, p)
    geom_xmat[world, geom] = wp.quat_to_matrix(wp.normalize(q * wp.quat(g[1], g[2], g[3], g[0])))
