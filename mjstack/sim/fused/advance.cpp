// The end of a step with the integrator implicitfast: mujoco_warp.implicit. tree.cpp is before
// it.

SHARED float h[NV * LD], acc[NV], qvel[NV];
SHARED float slope[NA + 1];  // of actuators' forces at their joints, by the joints' velocity
SHARED int driven[NA + 1], first[NV];  // -1 - t: by tendon t
SHARED float pull[NT * NV + 1], ten_slope[NT + 1];
SHARED float free_acc[6 * NFREE + 1];
SHARED bool solved[NFREE + 1];

load(io.qvel, NV, qvel);
load(io.efc_Ma, NV, acc);
load_pulls(pull);
for (int i = lane; i < NV; i += T) first[i] = io.M_colind.data[io.M_rowadr.data[i]];
for (int e = lane; e < NV * LD; e += T) h[e] = 0.0f;
SYNC();
for (int e = lane; e < NC; e += T) {
  const int i = io.M_hinit_i.data[e];
  h[i * LD + io.M_colind.data[e] - first[i]] = of_world(io.M)[e];
}
SYNC();

const float timestep = field(io.opt_timestep)[0];
const bool dampers = !(io.opt_disableflags & NO_DAMPER);
const bool derivative = dampers && !(io.opt_disableflags & NO_ACTUATION);

// How actuators' forces change with the velocity; not at all where a range cuts them off
for (int u = lane; u < NA; u += T) {
  const float *gainprm = field(io.actuator_gainprm) + 10 * u;
  const int target = io.actuator_trnid.data[u][0];
  const bool is_tendon = NT && io.actuator_trntype.data[u] == TENDON;
  const float gain = io.actuator_gaintype.data[u] == GAIN_AFFINE ? gainprm[2] : 0.0f;
  float value = 0.0f;
  if (io.actuator_biastype.data[u] == BIAS_AFFINE) value = field(io.actuator_biasprm)[10 * u + 2];
  if (gain != 0.0f) {
    float control = 0.0f;
    if (io.actuator_dyntype.data[u] == NONE) {
      control = of_world(io.ctrl)[u];
    } else {
      const int last = io.actuator_actadr.data[u] + io.actuator_actnum.data[u] - 1;
      control = of_world(io.act)[last];
      if (io.actuator_actearly.data[u])
        control = next_activation(io, u, control, of_world(io.act_dot)[last],
                                  io.actuator_actlimited.data[u], timestep);
    }
    value += gain * control;
  }
  auto outside = [](float x, const float *range) { return x <= range[0] || x >= range[1]; };
  const float *forces = of_world(io.actuator_force);
  if (io.actuator_forcelimited.data[u] && outside(forces[u], field(io.actuator_forcerange) + 2 * u))
    value = 0.0f;
  if (is_tendon) {
    driven[u] = -1 - target;
    const float *range = field(io.tendon_actfrcrange) + 2 * target;
    float total = 0.0f;
    for (int o = 0; o < NA; ++o)
      if (io.actuator_trntype.data[o] == TENDON && io.actuator_trnid.data[o][0] == target)
        total += forces[o];
    // The shares of the limit add up to it but for rounding.
    const float low = range[0] + 1e-5f * fabsf(range[0]), high = range[1] - 1e-5f * fabsf(range[1]);
    if (io.tendon_actfrclimited.data[target] && (total <= low || total >= high)) value = 0.0f;
  } else {
    const int dof = driven[u] = io.jnt_dofadr.data[target];
    const float total = of_world(io.qfrc_actuator)[dof];
    if (io.jnt_actfrclimited.data[target] && outside(total, field(io.jnt_actfrcrange) + 2 * target))
      value = 0.0f;
  }
  const float gear = field(io.actuator_gear)[6 * u];
  slope[u] = gear * gear * value;
}

// Damping of a degree of freedom as the inertia sees it
auto damping = [&](int i) {
  const Damping c = dof_damping(i);
  return dampers ? poly_slope(c.k, c.p, fabsf(qvel[i])) : 0.0f;
};

// A free body that is a tree by itself has the derivative of its gyroscopic force as well: one
// thread does its six equations, which are not symmetric, by LU with pivots.
for (int f = lane; f < NFREE; f += T) {
  const int b = io.body_freeadr.data[f], adr = io.body_dofadr.data[b];
  float a[6][6], x[6];
  WP_PRAGMA_UNROLL
  for (int r = 0; r < 6; ++r) {
    WP_PRAGMA_UNROLL
    for (int c = 0; c <= r; ++c) {
      const int at = adr + c - first[adr + r];  // a simple body's inertia has a diagonal alone
      a[r][c] = a[c][r] = at >= 0 ? h[(adr + r) * LD + at] : 0.0f;
    }
    a[r][r] += timestep * damping(adr + r);
    x[r] = acc[adr + r];
  }
  float i[10] = {};
  for (int k = b; k < b + io.body_subtreenum.data[b]; ++k) {
    WP_PRAGMA_UNROLL
    for (int e = 0; e < 10; ++e) i[e] += of_world(io.cinert)[10 * k + e];
  }
  const float *m = of_world(io.xmat) + 9 * b;
  const V3 column[3] = {{m[0], m[3], m[6]}, {m[1], m[4], m[7]}, {m[2], m[5], m[8]}};
  const V3 s = vec(of_world(io.subtree_com), b) - vec(of_world(io.xpos), b);
  const float *turning = qvel + adr + 3;
  const V3 w = column[0] * turning[0] + column[1] * turning[1] + column[2] * turning[2];
  auto inertia = [&](const V3 &v) {
    return V3{i[0] * v.x + i[3] * v.y + i[4] * v.z, i[3] * v.x + i[1] * v.y + i[5] * v.z,
              i[4] * v.x + i[5] * v.y + i[2] * v.z};
  };
  const V3 spin = inertia(w), swing = cross(w, s);
  const float along = dot(w, s);
  WP_PRAGMA_UNROLL
  for (int c = 0; c < 3; ++c) {
    const V3 &u = column[c];
    // K u = s (w u) - u (w s) + (w x s) x u; the torque's derivative is
    // -mass s x (K u) + w x (I u) - (I w) x u.
    const V3 lin = s * dot(w, u) - u * along + cross(swing, u);
    const V3 rot = cross(s, lin) * -i[9] + cross(w, inertia(u)) - cross(spin, u);
    a[0][3 + c] += -timestep * i[9] * lin.x;
    a[1][3 + c] += -timestep * i[9] * lin.y;
    a[2][3 + c] += -timestep * i[9] * lin.z;
    WP_PRAGMA_UNROLL
    for (int r = 0; r < 3; ++r) a[3 + r][3 + c] += timestep * dot(column[r], rot);
  }
  bool regular = true;
  WP_PRAGMA_UNROLL
  for (int k = 0; k < 6; ++k) {
    // The largest of the column comes to the diagonal.
    WP_PRAGMA_UNROLL
    for (int r = k + 1; r < 6; ++r) {
      if (fabsf(a[r][k]) > fabsf(a[k][k])) {
        WP_PRAGMA_UNROLL
        for (int c = k; c < 6; ++c) {
          const float upper = a[k][c];
          a[k][c] = a[r][c];
          a[r][c] = upper;
        }
        const float upper = x[k];
        x[k] = x[r];
        x[r] = upper;
      }
    }
    if (fabsf(a[k][k]) < TINY) regular = false;
    const float inverse = 1.0f / a[k][k];
    WP_PRAGMA_UNROLL
    for (int r = k + 1; r < 6; ++r) {
      const float scale = a[r][k] * inverse;
      x[r] -= scale * x[k];
      WP_PRAGMA_UNROLL
      for (int c = k + 1; c < 6; ++c) a[r][c] -= scale * a[k][c];
    }
  }
  WP_PRAGMA_UNROLL
  for (int k = 5; k >= 0; --k) {
    WP_PRAGMA_UNROLL
    for (int c = k + 1; c < 6; ++c) x[k] -= a[k][c] * x[c];
    x[k] /= a[k][k];
  }
  WP_PRAGMA_UNROLL
  for (int r = 0; r < 6; ++r) free_acc[6 * f + r] = x[r];
  solved[f] = regular;
}
SYNC();

// All other trees: their inertia, less the forces' derivative
const int nothing = NO_ACTUATION | NO_SPRING | NO_DAMPER;
if ((io.opt_disableflags & nothing) == nothing) {
  load(io.qacc, NV, acc);
} else {
  for (int i = lane; derivative && i < NV; i += T) {
    float total = 0.0f;
    for (int u = 0; u < NA; ++u)
      if (driven[u] == i) total += slope[u];
    h[i * LD + i - first[i]] -= timestep * (total - damping(i));
  }
  for (int t = lane; t < NT; t += T) {
    const Damping c = tendon_damping(t);
    const float speed = fabsf(of_world(io.ten_velocity)[t]);
    float total = dampers ? poly_slope(c.k, c.p, speed) : 0.0f;
    for (int u = 0; derivative && u < NA; ++u)
      if (driven[u] == -1 - t) total -= slope[u];
    ten_slope[t] = timestep * total;
  }
  SYNC();
  for (int e = lane; NT && e < NC; e += T) {  // those that lie in the inertia's pattern
    const int i = io.M_hinit_i.data[e], j = io.M_colind.data[e];
    for (int t = 0; t < NT; ++t)
      h[i * LD + j - first[i]] += ten_slope[t] * pull[t * NV + i] * pull[t * NV + j];
  }
  SYNC();
  solve(first, h, acc);
  for (int e = lane; e < 6 * NFREE; e += T)
    if (solved[e / 6]) acc[io.body_dofadr.data[io.body_freeadr.data[e / 6]] + e % 6] = free_acc[e];
}
SYNC();

// The state one step later
for (int u = lane; NACT && u < NA; u += T) {
  const int from = io.actuator_actadr.data[u], end = from + io.actuator_actnum.data[u];
  for (int k = wp::max(from, 0); k < end; ++k)
    of_world(io.act)[k] = next_activation(io, u, of_world(io.act)[k], of_world(io.act_dot)[k],
                                          io.actuator_actlimited.data[u], timestep);
}
for (int i = lane; i < NV; i += T) qvel[i] += acc[i] * timestep;
SYNC();
store(io.qvel, NV, qvel);
for (int j = lane; j < NJNT; j += T) {
  float *q = of_world(io.qpos) + io.jnt_qposadr.data[j];
  const float *v = qvel + io.jnt_dofadr.data[j];
  const int type = io.jnt_type.data[j], places = type == FREE ? 3 : type == BALL ? 0 : 1;
  for (int k = 0; k < places; ++k) q[k] += timestep * v[k];
  if (places == 1) continue;
  q += places;
  const V3 spin = vec(v + places, 0);
  const float size = length(spin);
  const V3 about = size > 0.0f ? spin * (1.0f / size) : V3{0.0f, 0.0f, 0.0f};
  const Quat old = normalized(quat(q, 0));
  const Quat next = normalized(product(old, turn(about, timestep * size)));
  put_quat(q, 0, next);
}
for (int i = lane; i < NV; i += T) of_world(io.qacc_warmstart)[i] = of_world(io.qacc)[i];
if (lane == 0) {
  io.time.data[world] += timestep;
  int bits = 0;
  if (io.nefc.data[world] > io.njmax) bits |= LIMIT_NEFC;
  if (io.ncollision.data[0] > io.naconmax) bits |= LIMIT_BROADPHASE;
  if (io.nacon.data[0] > io.naconmax) bits |= LIMIT_NARROWPHASE;
  if (bits) io.overflow.data[world] |= bits;
}
