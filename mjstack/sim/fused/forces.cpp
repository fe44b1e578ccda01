// Inertia, velocities, all forces but the constraints', and the acceleration without constraints:
// mujoco_warp.crb, tendon_armature, transmission, fwd_velocity, fwd_actuation and fwd_acceleration.
// tree.cpp is before it.

SHARED float inertia[10 * NBODY], composite[10 * NBODY];
SHARED float motion[6 * NV], motion_rate[6 * NV], momentum[6 * NV];
SHARED float reached[6 * NV];  // velocity after a degree of freedom and all before it
SHARED float velocity[6 * NBODY], force[6 * NBODY];
SHARED float qvel[NV], bias[NV], h[NV * LD], acc[NV];
SHARED float torque[NA + 1];  // of actuators, at their joints
SHARED int driven[NA + 1], first[NV];
SHARED float pull[NT * NV + 1];
SHARED float ten_speed[NT + 1], ten_passive[NT + 1], ten_driving[NT + 1], ten_armature[NT + 1];
SHARED unsigned long long movers[NBODY];  // degrees of freedom that move a body, as bits

load(io.cinert, 10 * NBODY, inertia);
load(io.cdof, 6 * NV, motion);
load(io.qvel, NV, qvel);
load_pulls(pull);
for (int i = lane; i < NV; i += T) first[i] = io.M_colind.data[io.M_rowadr.data[i]];
for (int e = lane; e < NV * LD; e += T) h[e] = 0.0f;
for (int b = lane; b < NBODY; b += T) {
  unsigned long long bits = 0;
  WP_PRAGMA_UNROLL
  for (int k = 0; k < NV; ++k)
    if (wp::index(io.body_isdofancestor, b, k)) bits |= 1ull << k;
  movers[b] = bits;
}
SYNC();

// Calls a function with the degrees of freedom that bits names, the first one first
auto for_bits = [](unsigned long long bits, auto call) {
  for (; bits; bits &= bits - 1) {
#ifdef __CUDA_ARCH__
    call(__ffsll(bits) - 1);
#else
    call(__builtin_ctzll(bits));
#endif
  }
};

// Inertia of subtrees, and velocities along the degrees of freedom
for (int e = lane; e < 10 * NBODY; e += T) {
  float total = inertia[e];
  const int b = e / 10, count = b ? io.body_subtreenum.data[b] : 1;
  for (int k = 1; k < count; ++k) total += inertia[e + 10 * k];
  composite[e] = total;
}
for (int i = lane; i < NV; i += T) {
  const int joint = io.dof_jntid.data[i], start = io.jnt_dofadr.data[joint];
  const bool free = io.jnt_type.data[joint] == FREE;
  // The three turns of a free joint or ball are one: none changes the others' axes.
  const int begin = free ? start + 3 : io.jnt_type.data[joint] == BALL ? start : i;
  const unsigned long long bits = movers[io.dof_bodyid.data[i]], earlier = (1ull << begin) - 1ull;
  Spatial v{};
  auto add = [&](int k) { v = v + spatial(motion, k) * qvel[k]; };
  for_bits(bits & earlier, add);
  const Spatial before = v;
  for_bits(bits & ~earlier & ((2ull << i) - 1ull), add);
  put_spatial(reached, i, v);
  put_spatial(motion_rate, i, free && i < begin ? Spatial{} : cross_motion(before, spatial(motion, i)));
}
SYNC();

// Bodies' velocities, and the forces that keep their velocities
const float *g = field(io.opt_gravity);
const float gravity = io.opt_disableflags & NO_GRAVITY ? 0.0f : 1.0f;
for (int b = lane; b < NBODY; b += T) {
  const int w = io.body_weldid.data[b], dofs = io.body_dofnum.data[w];
  Spatial v{}, f{};
  if (dofs) v = spatial(reached, io.body_dofadr.data[w] + dofs - 1);
  if (b) {
    Spatial a{V3{0.0f, 0.0f, 0.0f}, vec(g, 0) * -gravity};
    for_bits(movers[b], [&](int k) { a = a + spatial(motion_rate, k) * qvel[k]; });
    f = momentum_of(inertia + 10 * b, a) + cross_force(v, momentum_of(inertia + 10 * b, v));
  }
  put_spatial(velocity, b, v);
  put_spatial(force, b, f);
}
SYNC();
for (int i = lane; i < NV; i += T) {
  const int b = io.dof_bodyid.data[i], end = b + io.body_subtreenum.data[b];
  Spatial total{};
  for (int k = b; k < end; ++k) total = total + spatial(force, k);
  bias[i] = inner(spatial(motion, i), total);
  put_spatial(momentum, i, momentum_of(composite + 10 * b, spatial(motion, i)));
}
SYNC();
store(io.cvel, 6 * NBODY, velocity);
store(io.cdof_dot, 6 * NV, motion_rate);
store(io.qfrc_bias, NV, bias);

// Tendons: armature, springs and dampers
const bool springs = !(io.opt_disableflags & NO_SPRING), dampers = !(io.opt_disableflags & NO_DAMPER);
for (int t = lane; t < NT; t += T) {
  float speed = 0.0f, total = 0.0f;
  for (int k = 0; k < NV; ++k) speed += pull[t * NV + k] * qvel[k];
  if (springs) {
    const float length = of_world(io.ten_length)[t];
    const float *rest = field(io.tendon_lengthspring) + 2 * t;
    const float x = length > rest[1] ? length - rest[1] : length < rest[0] ? length - rest[0] : 0.0f;
    total -= x * poly(field(io.tendon_stiffness)[t], field(io.tendon_stiffnesspoly) + 2 * t, x);
  }
  if (dampers) {
    const Damping c = tendon_damping(t);
    total -= speed * poly(c.k, c.p, fabsf(speed));
  }
  const int owner = io.tendon_actuatorid.data[t];
  ten_armature[t] =
      field(io.tendon_armature)[t] + actuator_sum(io.actuator_armature, 1, 0, owner, t, true);
  ten_speed[t] = speed;
  ten_passive[t] = total;
  of_world(io.ten_velocity)[t] = speed;
}
SYNC();

// The inertia
for (int e = lane; e < NC; e += T) {
  const int i = io.M_hinit_i.data[e], j = io.M_colind.data[e];
  float armature = 0.0f;
  if (i == j) {
    const int joint = io.dof_jntid.data[i], owner = io.jnt_actuatorid.data[joint];
    armature = field(io.dof_armature)[i];
    armature += actuator_sum(io.actuator_armature, 1, 0, owner, joint, false);
  }
  for (int t = 0; t < NT; ++t)
    armature += ten_armature[t] * pull[t * NV + i] * pull[t * NV + j];
  const float value = armature + inner(spatial(motion, j), spatial(momentum, i));
  h[i * LD + j - first[i]] = value;
  of_world(io.M)[e] = value;
}

// Actuators of joints and tendons
const float timestep = field(io.opt_timestep)[0];
const bool active = !(io.opt_disableflags & NO_ACTUATION);
for (int u = lane; u < NA; u += T) {
  const int target = io.actuator_trnid.data[u][0];
  const bool is_tendon = NT && io.actuator_trntype.data[u] == TENDON;
  const int dof = is_tendon ? -1 : io.jnt_dofadr.data[target];
  const float gear = field(io.actuator_gear)[6 * u];
  const float length = gear * (is_tendon ? of_world(io.ten_length)[target]
                                         : of_world(io.qpos)[io.jnt_qposadr.data[target]]);
  const float speed = gear * (is_tendon ? ten_speed[target] : qvel[dof]);
  const int from = io.actuator_ctrladr.data[u];
  float control = 0.0f;
  if (io.actuator_ctrlnum.data[u] > 0) {
    control = of_world(io.ctrl)[from];
    const float *range = field(io.actuator_ctrlrange) + 2 * from;
    if (io.actuator_ctrllimited.data[from] && !(io.opt_disableflags & NO_CLAMPCTRL))
      control = wp::clamp(control, range[0], range[1]);
  }
  const int last = io.actuator_actadr.data[u] + io.actuator_actnum.data[u] - 1;
  if (NACT && io.actuator_actadr.data[u] >= 0) {
    const int kind = io.actuator_dyntype.data[u];
    const float act = of_world(io.act)[last];
    const float tau = wp::max(field(io.actuator_dynprm)[10 * u], TINY);
    const float rate = kind == INTEGRATOR ? control : (control - act) / tau;
    of_world(io.act_dot)[last] = active ? rate : 0.0f;
    control = act;
    if (io.actuator_actearly.data[u])
      control = next_activation(io, u, act, rate, io.actuator_actlimited.data[u], timestep);
  }
  const float *k = field(io.actuator_gainprm) + 10 * u, *c = field(io.actuator_biasprm) + 10 * u;
  float gain = k[0], value = 0.0f;
  if (io.actuator_gaintype.data[u] == GAIN_AFFINE) gain = k[0] + k[1] * length + k[2] * speed;
  if (io.actuator_biastype.data[u] == BIAS_AFFINE) value = c[0] + c[1] * length + c[2] * speed;
  value = gain * control + value;
  if (!is_tendon && io.actuator_forcelimited.data[u]) {
    const float *range = field(io.actuator_forcerange) + 2 * u;
    value = wp::clamp(value, range[0], range[1]);
  }
  if (!active) value = 0.0f;
  driven[u] = dof;
  torque[u] = is_tendon ? value : gear * value;
  of_world(io.actuator_length)[u] = length;
  of_world(io.actuator_velocity)[u] = speed;
  of_world(io.actuator_force)[u] = value;
}
SYNC();

// Those of a tendon share its limit, before their own ones.
for (int t = lane; t < NT; t += T) {
  auto attached = [&](int u) { return driven[u] < 0 && io.actuator_trnid.data[u][0] == t; };
  float total = 0.0f, driving = 0.0f;
  for (int u = 0; u < NA; ++u)
    if (attached(u)) total += torque[u];
  float share = 1.0f;
  if (io.tendon_actfrclimited.data[t] && total != 0.0f) {
    const float *range = field(io.tendon_actfrcrange) + 2 * t;
    if (total < range[0]) share = range[0] / total;
    if (total > range[1]) share = range[1] / total;
  }
  for (int u = 0; u < NA; ++u) {
    if (!attached(u)) continue;
    const float *range = field(io.actuator_forcerange) + 2 * u;
    float value = share * torque[u];
    if (io.actuator_forcelimited.data[u]) value = wp::clamp(value, range[0], range[1]);
    of_world(io.actuator_force)[u] = value;
    driving += field(io.actuator_gear)[6 * u] * value;
  }
  ten_driving[t] = driving;
}
SYNC();

// Whether a world has gravity compensation, or forces applied to bodies
bool compensated = false, pushed = false;
for (int b = 1 + lane; b < NBODY; b += T) compensated |= field(io.body_gravcomp)[b] != 0.0f;
for (int e = lane; e < 6 * NBODY; e += T) pushed |= of_world(io.xfrc_applied)[e] != 0.0f;
#ifdef __CUDA_ARCH__
compensated = __any_sync(~0u, compensated);
pushed = __any_sync(~0u, pushed);
#endif

// Passive forces, and the sum of all forces
for (int i = lane; i < NV; i += T) {
  const int joint = io.dof_jntid.data[i], b = io.dof_bodyid.data[i];
  const int end = b + io.body_subtreenum.data[b];
  const Spatial s = spatial(motion, i);
  const V3 root = vec(of_world(io.subtree_com), io.body_rootid.data[b]);

  float spring = 0.0f, damper = 0.0f;
  const float stiffness = field(io.jnt_stiffness)[joint];
  const float *curve = field(io.jnt_stiffnesspoly) + 2 * joint;
  if (springs && (stiffness != 0.0f || curve[0] != 0.0f || curve[1] != 0.0f)) {
    const int adr = io.jnt_qposadr.data[joint];
    const float *q = of_world(io.qpos) + adr, *rest = field(io.qpos_spring) + adr;
    const int type = io.jnt_type.data[joint], places = type == FREE ? 3 : 0;
    if (type == FREE || type == BALL) {
      const int part = i - io.jnt_dofadr.data[joint];
      V3 away = vec(q, 0) - vec(rest, 0);
      if (part >= places) {
        const float *r = rest + places;
        const Quat from{r[0], -r[1], -r[2], -r[3]};
        const Quat d = product(from, normalized(quat(q + places, 0)));
        away = V3{d.x, d.y, d.z};
        const float sine = length(away);
        float angle = 2.0f * atan2f(sine, d.w);
        if (angle > PI) angle -= 2.0f * PI;
        away = sine == 0.0f ? V3{0.0f, 0.0f, 0.0f} : away * (angle / sine);
      }
      const float x = part % 3 == 0 ? away.x : part % 3 == 1 ? away.y : away.z;
      spring = -poly(stiffness, curve, length(away)) * x;
    } else {
      const float x = q[0] - rest[0];
      spring = -x * poly(stiffness, curve, x);
    }
  }
  if (dampers) {
    const Damping c = dof_damping(i);
    damper = -qvel[i] * poly(c.k, c.p, fabsf(qvel[i]));
  }
  float lift = 0.0f;
  if (compensated && gravity != 0.0f && (springs || dampers)) {
    for (int k = b; k < end; ++k) {
      const V3 up = vec(g, 0) * (-field(io.body_mass)[k] * field(io.body_gravcomp)[k]);
      lift += dot(s.l + cross(s.a, vec(of_world(io.xipos), k) - root), up);
    }
  }
  float applied = 0.0f;
  if (pushed) {
    for (int k = b; k < end; ++k) {
      const float *ft = of_world(io.xfrc_applied) + 6 * k;
      const V3 lever = cross(s.a, vec(of_world(io.xipos), k) - root);
      applied += dot(s.l, vec(ft, 0)) + dot(s.a, vec(ft, 1)) + dot(lever, vec(ft, 0));
    }
  }

  float driving = 0.0f;
  const bool by_actuator = io.jnt_actgravcomp.data[joint];
  if (NA && active) {
    for (int u = 0; u < NA; ++u)
      if (driven[u] == i) driving += torque[u];
    for (int t = 0; t < NT; ++t) driving += pull[t * NV + i] * ten_driving[t];
    if (by_actuator) driving += lift;
    if (io.jnt_actfrclimited.data[joint]) {
      const float *range = field(io.jnt_actfrcrange) + 2 * joint;
      driving = wp::clamp(driving, range[0], range[1]);
    }
  }
  float passive = spring + damper + (by_actuator ? 0.0f : lift);
  for (int t = 0; t < NT; ++t) passive += pull[t * NV + i] * ten_passive[t];
  const float total = passive - bias[i] + driving + of_world(io.qfrc_applied)[i] + applied;
  of_world(io.qfrc_passive)[i] = passive;
  of_world(io.qfrc_actuator)[i] = driving;
  of_world(io.qfrc_smooth)[i] = total;
  acc[i] = total;
}
SYNC();

solve(first, h, acc);
store(io.qacc_smooth, NV, acc);
