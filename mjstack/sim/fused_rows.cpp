// Constraint rows of elliptic and frictionless contacts, by the 32 threads of a warp that goes from
// contact to contact: the body of a Warp native function. A thread has one column of J after the
// other; then, of the contact's rows, one each.
//
// Constants that fused.py puts before it: NV degrees of freedom, STRIDE warps, and MuJoCo's numbers
// of the constraint types ELLIPTIC and FRICTIONLESS, and of the flag REFSAFE. On Warp's CPU device
// a block has one thread.

#ifdef __CUDA_ARCH__
constexpr int T = 32;
#else
constexpr int T = 1;
#endif
constexpr float TINY = 1e-15f;
constexpr float LEAST = 1e-4f, MOST = 0.9999f;  // of an impedance

const int count = wp::min(io.contact_dist.shape[0], io.nacon.data[0]);
for (int con = warp; con < count; con += STRIDE) {
  const float distance = io.contact_dist.data[con] - io.contact_includemargin.data[con];
  if (!(io.contact_type.data[con] & 1) || !(distance < 0.0f)) continue;
  const int world = io.contact_worldid.data[con];
  const int dim = io.contact_dim.data[con];

  // Room for the rows. Those beyond it are left out, and the count tells that they are.
  int first = 0;
#ifdef __CUDA_ARCH__
  if (lane == 0) first = atomicAdd(io.nefc.data + world, dim);
  first = __shfl_sync(~0u, first, 0);
#else
  first = io.nefc.data[world];
  io.nefc.data[world] += dim;
#endif
  const int rows = wp::max(0, wp::min(dim, io.efc_aref.shape[1] - first));
  for (int k = lane; k < dim; k += T)
    wp::index(io.contact_efc_address, con, k) = k < rows ? first + k : -1;

  // J, and the rows' velocities
  const auto &position = io.contact_pos.data[con];
  const auto &frame = io.contact_frame.data[con];
  const auto &geoms = io.contact_geom.data[con];
  const int body[2] = {io.geom_bodyid.data[geoms[0]], io.geom_bodyid.data[geoms[1]]};
  float offset[2][3];
  for (int side = 0; side < 2; ++side) {
    const auto &com = wp::index(io.subtree_com, world, io.body_rootid.data[body[side]]);
    for (int k = 0; k < 3; ++k) offset[side][k] = position[k] - com[k];
  }
  float velocity[6] = {};
  for (int c = lane; c < NV; c += T) {
    const auto &motion = wp::index(io.cdof, world, c);  // angular, then linear
    float linear[3] = {}, angular[3] = {};
    for (int side = 0; side < 2; ++side) {
      if (!wp::index(io.body_isdofancestor, body[side], c)) continue;
      const float sign = side ? 1.0f : -1.0f;
      const float *o = offset[side];
      linear[0] += sign * (motion[3] + motion[1] * o[2] - motion[2] * o[1]);
      linear[1] += sign * (motion[4] + motion[2] * o[0] - motion[0] * o[2]);
      linear[2] += sign * (motion[5] + motion[0] * o[1] - motion[1] * o[0]);
      for (int k = 0; k < 3; ++k) angular[k] += sign * motion[k];
    }
    const float speed = wp::index(io.qvel, world, c);
    WP_PRAGMA_UNROLL
    for (int k = 0; k < 6; ++k) {
      if (k >= rows) break;
      const float *x = k < 3 ? linear : angular;
      const float value = x[0] * frame.data[k % 3][0] + x[1] * frame.data[k % 3][1]
                          + x[2] * frame.data[k % 3][2];
      wp::index(io.efc_J, world, first + k, c) = value;
      velocity[k] += value * speed;
    }
  }
#ifdef __CUDA_ARCH__
  WP_PRAGMA_UNROLL
  for (int k = 0; k < 6; ++k)
    for (int step = 16; step; step >>= 1) velocity[k] += __shfl_xor_sync(~0u, velocity[k], step);
#endif

  // Impedance: https://mujoco.readthedocs.io/en/latest/modeling.html#solver-parameters
  const auto &solimp = io.contact_solimp.data[con];
  const float low = wp::min(wp::max(solimp[0], LEAST), MOST);
  const float high = wp::min(wp::max(solimp[1], LEAST), MOST);
  const float middle = wp::min(wp::max(solimp[3], LEAST), MOST);
  const float power = wp::max(1.0f, solimp[4]);
  const float depth = fabsf(distance) / wp::max(TINY, solimp[2]);
  float impedance;
  if (low == high || solimp[2] <= TINY) {
    impedance = 0.5f * (low + high);
  } else if (depth <= 0.0f) {
    impedance = low;
  } else if (depth >= 1.0f) {
    impedance = high;
  } else {
    float y = depth;
    if (power != 1.0f)
      y = depth <= middle ? powf(depth, power) / powf(middle, power - 1.0f)
                          : 1.0f - powf(1.0f - depth, power) / powf(1.0f - middle, power - 1.0f);
    // Of a dmin above dmax MJWarp would always make dmax; MuJoCo does this.
    impedance = wp::min(wp::max(low + y * (high - low), wp::min(low, high)), wp::max(low, high));
  }
  const auto &normal_ref = io.contact_solref.data[con];
  const auto &friction_ref = io.contact_solreffriction.data[con];
  const auto &friction = io.contact_friction.data[con];
  const float timestep = io.opt_timestep.data[world % io.opt_timestep.shape[0]];
  const float impratio = io.opt_impratio_invsqrt.data[world % io.opt_impratio_invsqrt.shape[0]];
  const int shared = world % io.body_invweight0.shape[0];
  const float weight = wp::index(io.body_invweight0, shared, body[0])[0]
                       + wp::index(io.body_invweight0, shared, body[1])[0];
  const float D = 1.0f / wp::max(weight * (1.0f - impedance) / impedance, TINY);

  // The rows
  for (int k = lane; k < rows; k += T) {
    const int r = first + k;
    const bool own = k > 0 && (friction_ref[0] != 0.0f || friction_ref[1] != 0.0f);
    const auto &ref = own ? friction_ref : normal_ref;
    const float least_time = io.disableflags & REFSAFE ? ref[0] : wp::max(ref[0], 2.0f * timestep);
    const float damping = ref[1] <= 0.0f ? -ref[1] / wp::max(TINY, high)
                                         : 2.0f / wp::max(TINY, high * least_time);
    float speed = velocity[0];
    WP_PRAGMA_UNROLL
    for (int j = 1; j < 6; ++j)
      if (j == k) speed = velocity[j];
    float aref = -damping * speed, scale = 1.0f;
    if (k == 0) {
      const float stiffness =
          ref[0] <= 0.0f ? -ref[0] / wp::max(TINY, high * high)
                         : 1.0f / wp::max(TINY, high * high * least_time * least_time * ref[1] * ref[1]);
      aref = -stiffness * impedance * distance - damping * speed;
    } else {
      const float ratio = friction[0] / friction[k - 1];
      scale = impratio * impratio * (k > 1 ? ratio * ratio : 1.0f);
    }
    wp::index(io.efc_D, world, r) = D / scale;
    wp::index(io.efc_aref, world, r) = aref;
    wp::index(io.efc_vel, world, r) = speed;
    wp::index(io.efc_pos, world, r) = (k ? 0.0f : distance) + io.contact_includemargin.data[con];
    wp::index(io.efc_margin, world, r) = io.contact_includemargin.data[con];
    wp::index(io.efc_frictionloss, world, r) = 0.0f;
    wp::index(io.efc_type, world, r) = dim == 1 ? FRICTIONLESS : ELLIPTIC;
    wp::index(io.efc_id, world, r) = con;
  }
}
