// Poses of bodies, joints, geoms and sites, and what is computed about the trees' centres of mass:
// mujoco_warp.kinematics, com_pos, and tendon of fixed tendons. tree.cpp is before it.

SHARED float xpos[3 * NBODY], xquat[4 * NBODY], xmat[9 * NBODY];
SHARED float xipos[3 * NBODY], ximat[9 * NBODY], com[3 * NBODY], inertia[10 * NBODY];
SHARED float anchor[3 * NJNT], axis[3 * NJNT], motion[6 * NV];
SHARED float geom_xpos[3 * NGEOM + 1], geom_xmat[9 * NGEOM + 1];
SHARED float site_xpos[3 * NSITE + 1], site_xmat[9 * NSITE + 1];
SHARED bool moves[NGEOM + 1];
SHARED float local_pos[3 * NBODY], local_quat[4 * NBODY];  // of a body in its parent's frame
SHARED float mass[NBODY];

// Every body in its parent's frame
const float *qpos = of_world(io.qpos);
const float *qpos0 = field(io.qpos0);
for (int b = lane; b < NBODY; b += T) {
  V3 p = vec(field(io.body_pos), b);
  Quat q = quat(field(io.body_quat), b);
  const int mocap = io.body_mocapid.data[b];
  if (mocap >= 0) {
    p = vec(of_world(io.mocap_pos), mocap);
    q = quat(of_world(io.mocap_quat), mocap);
  }
  const int first = io.body_jntadr.data[b], count = io.body_jntnum.data[b];
  for (int j = first; j < first + count; ++j) {
    const V3 direction = vec(field(io.jnt_axis), j), place = vec(field(io.jnt_pos), j);
    const float *at = qpos + io.jnt_qposadr.data[j];
    const int type = io.jnt_type.data[j];
    if (type == FREE) {  // its parent is the world
      p = vec(at, 0);
      q = normalized(Quat{at[3], at[4], at[5], at[6]});
      put(anchor, j, p);
      put(axis, j, direction);
      continue;
    }
    const V3 pivot = rotated(place, q) + p, along = rotated(direction, q);
    const float x = at[0] - qpos0[io.jnt_qposadr.data[j]];
    if (type == SLIDE) {
      p = p + along * x;
    } else {
      q = product(q, type == BALL ? normalized(quat(at, 0)) : turn(direction, x));
      p = pivot - rotated(place, q);
    }
    put(anchor, j, pivot);
    put(axis, j, along);
  }
  put(local_pos, b, p);
  put_quat(local_quat, b, q);
  mass[b] = field(io.body_mass)[b];
}
SYNC();

// Along every branch from the root; branches that share bodies write the same there
if (lane == 0) {
  put(xpos, 0, V3{0.0f, 0.0f, 0.0f});
  put_quat(xquat, 0, Quat{1.0f, 0.0f, 0.0f, 0.0f});
}
for (int branch = lane; branch < NBRANCH; branch += T) {
  V3 p{0.0f, 0.0f, 0.0f};
  Quat q{1.0f, 0.0f, 0.0f, 0.0f};
  const int end = io.body_branch_start.data[branch + 1];
  for (int i = io.body_branch_start.data[branch]; i < end; ++i) {
    const int b = io.body_branches.data[i];
    p = rotated(vec(local_pos, b), q) + p;
    q = normalized(product(q, quat(local_quat, b)));
    put(xpos, b, p);
    put_quat(xquat, b, q);
  }
}
SYNC();

// What is fixed to bodies
for (int b = lane; b < NBODY; b += T) {
  const Quat q = quat(xquat, b);
  put_matrix(xmat, b, q);
  put(xipos, b, vec(xpos, b) + rotated(vec(field(io.body_ipos), b), q));
  put_matrix(ximat, b, product(q, quat(field(io.body_iquat), b)));
}
for (int j = lane; j < NJNT; j += T) {
  const int parent = io.body_parentid.data[io.jnt_bodyid.data[j]];
  const Quat q = quat(xquat, parent);
  put(anchor, j, rotated(vec(anchor, j), q) + vec(xpos, parent));
  put(axis, j, rotated(vec(axis, j), q));
}
for (int g = lane; g < NGEOM; g += T) {
  // Geoms that never move were placed when the data was made.
  const int b = io.geom_bodyid.data[g];
  moves[g] = io.body_weldid.data[b] != 0 || io.body_mocapid.data[io.body_rootid.data[b]] != -1;
  const Quat q = quat(xquat, b);
  put(geom_xpos, g, vec(xpos, b) + rotated(vec(field(io.geom_pos), g), q));
  put_matrix(geom_xmat, g, product(q, quat(field(io.geom_quat), g)));
}
for (int s = lane; s < NSITE; s += T) {
  const int b = io.site_bodyid.data[s];
  const Quat q = quat(xquat, b);
  put(site_xpos, s, vec(xpos, b) + rotated(vec(field(io.site_pos), s), q));
  put_matrix(site_xmat, s, product(q, quat(field(io.site_quat), s)));
}
SYNC();

// Centres of mass: a subtree's bodies follow each other
for (int b = lane; b < NBODY; b += T) {
  V3 sum{0.0f, 0.0f, 0.0f};
  const int end = b + io.body_subtreenum.data[b];
  for (int j = b; j < end; ++j) sum = sum + vec(xipos, j) * mass[j];
  const float total = field(io.body_subtreemass)[b];
  put(com, b, total < TINY ? vec(xipos, b) : sum * (1.0f / total));
}
SYNC();

// Bodies' inertia and joints' motion about the centre of mass of their tree
for (int b = lane; b < NBODY; b += T) {
  const V3 diagonal = vec(field(io.body_inertia), b);
  const V3 d = vec(xipos, b) - vec(com, io.body_rootid.data[b]);
  const float m = mass[b];
  const V3 r0 = vec(ximat, 3 * b), r1 = vec(ximat, 3 * b + 1), r2 = vec(ximat, 3 * b + 2);
  auto turned = [&](const V3 &u, const V3 &v) {
    return dot(V3{u.x * diagonal.x, u.y * diagonal.y, u.z * diagonal.z}, v);
  };
  float *i = inertia + 10 * b;
  i[0] = turned(r0, r0) + m * (d.y * d.y + d.z * d.z);
  i[1] = turned(r1, r1) + m * (d.x * d.x + d.z * d.z);
  i[2] = turned(r2, r2) + m * (d.x * d.x + d.y * d.y);
  i[3] = turned(r0, r1) - m * d.x * d.y;
  i[4] = turned(r0, r2) - m * d.x * d.z;
  i[5] = turned(r1, r2) - m * d.y * d.z;
  i[6] = m * d.x;
  i[7] = m * d.y;
  i[8] = m * d.z;
  i[9] = m;
}
for (int j = lane; j < NJNT; j += T) {
  const int b = io.jnt_bodyid.data[j], dof = io.jnt_dofadr.data[j], type = io.jnt_type.data[j];
  const V3 offset = vec(com, io.body_rootid.data[b]) - vec(anchor, j), zero{0.0f, 0.0f, 0.0f};
  const V3 along = vec(axis, j);
  if (type == SLIDE) {
    put_spatial(motion, dof, Spatial{zero, along});
  } else if (type == HINGE) {
    put_spatial(motion, dof, Spatial{along, cross(along, offset)});
  } else {
    for (int k = 0; k < 3; ++k) {
      const V3 unit{k == 0 ? 1.0f : 0.0f, k == 1 ? 1.0f : 0.0f, k == 2 ? 1.0f : 0.0f};
      if (type == FREE) put_spatial(motion, dof + k, Spatial{zero, unit});
      const V3 column{xmat[9 * b + k], xmat[9 * b + 3 + k], xmat[9 * b + 6 + k]};
      put_spatial(motion, dof + k + (type == FREE ? 3 : 0), Spatial{column, cross(column, offset)});
    }
  }
}
SYNC();

// Fixed tendons
for (int t = lane; t < NT; t += T) {
  const int start = io.tendon_adr.data[t], row = io.ten_J_rowadr.data[t];
  float length = 0.0f;
  for (int w = start; w < start + io.tendon_num.data[t]; ++w) {
    const int joint = io.wrap_objid.data[w];
    const float coefficient = io.wrap_prm.data[w];
    length += coefficient * qpos[io.jnt_qposadr.data[joint]];
    for (int k = row; k < row + io.ten_J_rownnz.data[t]; ++k)
      if (io.ten_J_colind.data[k] == io.jnt_dofadr.data[joint]) of_world(io.ten_J)[k] = coefficient;
  }
  of_world(io.ten_length)[t] = length;
}

store(io.xpos, 3 * NBODY, xpos);
store(io.xquat, 4 * NBODY, xquat);
store(io.xmat, 9 * NBODY, xmat);
store(io.xipos, 3 * NBODY, xipos);
store(io.ximat, 9 * NBODY, ximat);
store(io.xanchor, 3 * NJNT, anchor);
store(io.xaxis, 3 * NJNT, axis);
for (int e = lane; e < 3 * NGEOM; e += T)
  if (moves[e / 3]) of_world(io.geom_xpos)[e] = geom_xpos[e];
for (int e = lane; e < 9 * NGEOM; e += T)
  if (moves[e / 9]) of_world(io.geom_xmat)[e] = geom_xmat[e];
store(io.site_xpos, 3 * NSITE, site_xpos);
store(io.site_xmat, 9 * NSITE, site_xmat);
store(io.subtree_com, 3 * NBODY, com);
store(io.cinert, 10 * NBODY, inertia);
store(io.cdof, 6 * NV, motion);
