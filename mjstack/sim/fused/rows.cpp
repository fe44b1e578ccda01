// Constraint rows of elliptic and frictionless contacts. A warp goes from group to group of contacts.
// A thread per contact of the group and row reads the contact's numbers, so that the group waits for
// memory once; in between, the threads are the columns of J of one contact after the other.
//
// Constants: NV degrees of freedom, WARPS.

constexpr int GROUP = T > 1 ? 8 : 1;
constexpr int SHARE = T / GROUP;           // threads of a contact
constexpr int THREAD_ROWS = (6 + SHARE - 1) / SHARE;  // rows of a thread, SHARE apart
constexpr float LEAST = 1e-4f, MOST = 0.9999f;  // of an impedance

const int count = wp::min(io.contact_dist.shape[0], io.nacon.data[0]);
for (int group = warp * GROUP; group < count; group += WARPS * GROUP) {
  const int con = wp::min(group + lane % GROUP, count - 1);
  const float margin = io.contact_includemargin.data[con];
  const float distance = io.contact_dist.data[con] - margin;
  const int world = io.contact_worldid.data[con];
  const bool counts =
      group + lane % GROUP < count && (io.contact_type.data[con] & 1) && distance < 0.0f;
  const int dim = counts ? io.contact_dim.data[con] : 0;

  // Room for the rows. Those beyond it are left out, and the count tells that they are.
  int first = 0;
#ifdef __CUDA_ARCH__
  if (lane < GROUP && dim) first = atomicAdd(io.nefc.data + world, dim);
  first = FROM(first, lane % GROUP);
#else
  first = io.nefc.data[world];
  io.nefc.data[world] += dim;
#endif
  const int rows = wp::max(0, wp::min(dim, io.efc_aref.shape[1] - first));
  for (int k = lane / GROUP; k < dim; k += SHARE)
    wp::index(io.contact_efc_address, con, k) = k < rows ? first + k : -1;

  // J, and the rows' velocities
  float frame[9], offset[6];
  int body[2];
  WP_PRAGMA_UNROLL
  for (int k = 0; k < 9; ++k) frame[k] = io.contact_frame.data[con].data[k / 3][k % 3];
  WP_PRAGMA_UNROLL
  for (int side = 0; side < 2; ++side) {
    body[side] = io.geom_bodyid.data[io.contact_geom.data[con][side]];
    const auto &com = wp::index(io.subtree_com, world, io.body_rootid.data[body[side]]);
    WP_PRAGMA_UNROLL
    for (int k = 0; k < 3; ++k) offset[3 * side + k] = io.contact_pos.data[con][k] - com[k];
  }
  float speeds[THREAD_ROWS] = {};
  for (int i = 0; i < GROUP; ++i) {
    const int its_rows = FROM(rows, i);
    if (!its_rows) continue;
    const int its_world = FROM(world, i), its_first = FROM(first, i);
    const int its_body[2] = {FROM(body[0], i), FROM(body[1], i)};
    float f[9], o[6], velocity[6] = {};
    WP_PRAGMA_UNROLL
    for (int k = 0; k < 9; ++k) f[k] = FROM(frame[k], i);
    WP_PRAGMA_UNROLL
    for (int k = 0; k < 6; ++k) o[k] = FROM(offset[k], i);
    for (int c = lane; c < NV; c += T) {
      float motion[6];  // angular, then linear
#ifdef __CUDA_ARCH__
      const float2 *pairs = reinterpret_cast<const float2 *>(&wp::index(io.cdof, its_world, c));
      WP_PRAGMA_UNROLL
      for (int k = 0; k < 3; ++k) {
        const float2 pair = __ldg(pairs + k);
        motion[2 * k] = pair.x;
        motion[2 * k + 1] = pair.y;
      }
#else
      for (int k = 0; k < 6; ++k) motion[k] = wp::index(io.cdof, its_world, c)[k];
#endif
      const float speed = READ(wp::index(io.qvel, its_world, c));
      float x[6] = {};  // of the bodies against each other, linear, then angular
      WP_PRAGMA_UNROLL
      for (int side = 0; side < 2; ++side) {
        const float sign =
            READ(wp::index(io.body_isdofancestor, its_body[side], c)) ? 2.0f * side - 1.0f : 0.0f;
        x[0] += sign * (motion[3] + motion[1] * o[3 * side + 2] - motion[2] * o[3 * side + 1]);
        x[1] += sign * (motion[4] + motion[2] * o[3 * side] - motion[0] * o[3 * side + 2]);
        x[2] += sign * (motion[5] + motion[0] * o[3 * side + 1] - motion[1] * o[3 * side]);
        WP_PRAGMA_UNROLL
        for (int k = 0; k < 3; ++k) x[3 + k] += sign * motion[k];
      }
      float *J = &wp::index(io.efc_J, its_world, its_first, c);
      WP_PRAGMA_UNROLL
      for (int k = 0; k < 6; ++k) {
        if (k >= its_rows) break;
        const int of = k / 3 * 3, axis = k % 3 * 3;
        const float value = x[of] * f[axis] + x[of + 1] * f[axis + 1] + x[of + 2] * f[axis + 2];
        J[k * (io.efc_J.strides[1] / sizeof(float))] = value;
        velocity[k] += value * speed;
      }
    }
    WP_PRAGMA_UNROLL
    for (int k = 0; k < 6; ++k) {
      if (k >= its_rows) break;
#ifdef __CUDA_ARCH__
      for (int step = 16; step; step >>= 1) velocity[k] += __shfl_xor_sync(~0u, velocity[k], step);
#endif
      if (i == lane % GROUP && k % SHARE == lane / GROUP) speeds[k / SHARE] = velocity[k];
    }
  }
  if (lane / GROUP >= rows) continue;

  // Impedance: https://mujoco.readthedocs.io/en/latest/modeling.html#solver-parameters
  const auto solimp = io.contact_solimp.data[con];
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
    if (power == 2.0f)  // MuJoCo's default
      y = depth <= middle ? depth * depth / middle
                          : 1.0f - (1.0f - depth) * (1.0f - depth) / (1.0f - middle);
    else if (power != 1.0f)
      y = depth <= middle ? powf(depth, power) / powf(middle, power - 1.0f)
                          : 1.0f - powf(1.0f - depth, power) / powf(1.0f - middle, power - 1.0f);
    // Of a dmin above dmax MJWarp would always make dmax; MuJoCo does this.
    impedance = wp::min(wp::max(low + y * (high - low), wp::min(low, high)), wp::max(low, high));
  }
  const auto normal_ref = io.contact_solref.data[con];
  const auto friction_ref = io.contact_solreffriction.data[con];
  const float timestep = io.opt_timestep.data[world % io.opt_timestep.shape[0]];
  const float impratio = io.opt_impratio_invsqrt.data[world % io.opt_impratio_invsqrt.shape[0]];
  const int shared = world % io.body_invweight0.shape[0];
  const float weight = wp::index(io.body_invweight0, shared, body[0])[0]
                       + wp::index(io.body_invweight0, shared, body[1])[0];
  const float D = 1.0f / wp::max(weight * (1.0f - impedance) / impedance, TINY);

  // The rows
  WP_PRAGMA_UNROLL
  for (int n = 0; n < THREAD_ROWS; ++n) {
    const int k = lane / GROUP + n * SHARE;
    if (k >= rows) break;
    const int r = first + k;
    const bool separate = k > 0 && (friction_ref[0] != 0.0f || friction_ref[1] != 0.0f);
    const auto ref = separate ? friction_ref : normal_ref;
    const float least_time = io.opt_disableflags & NO_REFSAFE ? ref[0] : wp::max(ref[0], 2.0f * timestep);
    const float damping = ref[1] <= 0.0f ? -ref[1] / wp::max(TINY, high)
                                         : 2.0f / wp::max(TINY, high * least_time);
    float aref = -damping * speeds[n], scale = 1.0f;
    if (k == 0) {
      const float stiffness =
          ref[0] <= 0.0f ? -ref[0] / wp::max(TINY, high * high)
                         : 1.0f / wp::max(TINY, high * high * least_time * least_time * ref[1] * ref[1]);
      aref = -stiffness * impedance * distance - damping * speeds[n];
    } else {
      const auto &friction = io.contact_friction.data[con];
      const float ratio = friction[0] / friction[k - 1];
      scale = impratio * impratio * (k > 1 ? ratio * ratio : 1.0f);
    }
    wp::index(io.efc_D, world, r) = D / scale;
    wp::index(io.efc_aref, world, r) = aref;
    wp::index(io.efc_vel, world, r) = speeds[n];
    wp::index(io.efc_pos, world, r) = (k ? 0.0f : distance) + margin;
    wp::index(io.efc_margin, world, r) = margin;
    wp::index(io.efc_frictionloss, world, r) = 0.0f;
    wp::index(io.efc_type, world, r) = dim == 1 ? FRICTIONLESS : ELLIPTIC;
    wp::index(io.efc_id, world, r) = con;
  }
}
