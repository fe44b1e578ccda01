// Constraint rows of elliptic and frictionless contacts, by the 32 threads of a warp that goes from
// group to group of contacts: the body of a Warp native function. A contact has four threads, one per
// row (and a second row each, if it has six), so that a group waits for memory once.
//
// Constants that fused.py puts before it: NV degrees of freedom, NVP columns of J (a multiple of 4),
// NBODY bodies, STRIDE warps, and MuJoCo's numbers of the constraint types ELLIPTIC and FRICTIONLESS,
// and of the flag REFSAFE. On Warp's CPU device a block has one thread.

#ifdef __CUDA_ARCH__
constexpr int T = 32, SHARE = 4;  // threads of a warp, and of a contact
__shared__ unsigned long long dofs[NBODY];
#else
constexpr int T = 1, SHARE = 1;
unsigned long long dofs[NBODY];
#endif
constexpr int GROUP = T / SHARE;               // contacts
constexpr int EACH = (6 + SHARE - 1) / SHARE;  // rows of a thread, SHARE apart
constexpr float TINY = 1e-15f;
constexpr float LEAST = 1e-4f, MOST = 0.9999f;  // of an impedance

// The degrees of freedom that move a body, a bit each
for (int b = lane; b < NBODY; b += T) {
  dofs[b] = 0;
  for (int c = 0; c < NV; ++c)
    dofs[b] |= (unsigned long long)(wp::index(io.body_isdofancestor, b, c) != 0) << c;
}
#ifdef __CUDA_ARCH__
__syncwarp();
#endif

const int count = wp::min(io.contact_dist.shape[0], io.nacon.data[0]);
for (int group = warp * GROUP; group < count; group += STRIDE * GROUP) {
  const bool there = group + lane / SHARE < count;
  const int con = there ? group + lane / SHARE : group;
  const float margin = io.contact_includemargin.data[con];
  const float distance = io.contact_dist.data[con] - margin;
  const int world = io.contact_worldid.data[con];
  const bool counts = there && (io.contact_type.data[con] & 1) && distance < 0.0f;
  const int dim = counts ? io.contact_dim.data[con] : 0;

  // Room for the rows. Those beyond it are left out, and the count tells that they are.
  int first = 0;
#ifdef __CUDA_ARCH__
  if (lane % SHARE == 0 && dim) first = atomicAdd(io.nefc.data + world, dim);
  first = __shfl_sync(~0u, first, lane / SHARE * SHARE);
#else
  first = io.nefc.data[world];
  io.nefc.data[world] += dim;
#endif
  const int rows = wp::max(0, wp::min(dim, io.efc_aref.shape[1] - first));
  for (int k = lane % SHARE; k < dim; k += SHARE)
    wp::index(io.contact_efc_address, con, k) = k < rows ? first + k : -1;
  if (lane % SHARE >= rows) continue;

  const int body[2] = {io.geom_bodyid.data[io.contact_geom.data[con][0]],
                       io.geom_bodyid.data[io.contact_geom.data[con][1]]};

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

#pragma unroll 1
  for (int n = 0; n < EACH; ++n) {
    const int k = lane % SHARE + n * SHARE;
    if (k >= rows) break;
    const int r = first + k;

    // The row of J: along an axis of the contact's frame, how fast one body's point moves against the
    // other's, or the body turns. Of a body that turns by w and moves by v it is move v + turn w.
    const auto &axis = io.contact_frame.data[con].data[k % 3];
    float move[3], turn[2][3];
    WP_PRAGMA_UNROLL
    for (int j = 0; j < 3; ++j) {
      move[j] = k < 3 ? axis[j] : 0.0f;
      turn[0][j] = turn[1][j] = axis[j];
    }
    WP_PRAGMA_UNROLL
    for (int side = 0; side < 2; ++side) {
      const auto &com = wp::index(io.subtree_com, world, io.body_rootid.data[body[side]]);
      const auto &at = io.contact_pos.data[con];
      const float x = at[0] - com[0], y = at[1] - com[1], z = at[2] - com[2];
      if (k >= 3) continue;
      turn[side][0] = y * move[2] - z * move[1];
      turn[side][1] = z * move[0] - x * move[2];
      turn[side][2] = x * move[1] - y * move[0];
    }
    const unsigned long long moves[2] = {dofs[body[0]], dofs[body[1]]};
    float *J = &wp::index(io.efc_J, world, r, 0);
    float speed = 0.0f;
#pragma unroll 1
    for (int quad = 0; quad < NVP; quad += 4) {
      float value[4] = {};
      WP_PRAGMA_UNROLL
      for (int j = 0; j < 4; ++j) {
        const int c = quad + j;
        if (c >= NV) break;
        float w[6];  // angular, then linear
#ifdef __CUDA_ARCH__
        const float2 *pairs = reinterpret_cast<const float2 *>(&wp::index(io.cdof, world, c));
        WP_PRAGMA_UNROLL
        for (int i = 0; i < 3; ++i) {
          const float2 pair = __ldg(pairs + i);
          w[2 * i] = pair.x;
          w[2 * i + 1] = pair.y;
        }
        const float rate = __ldg(&wp::index(io.qvel, world, c));
#else
        for (int i = 0; i < 6; ++i) w[i] = wp::index(io.cdof, world, c)[i];
        const float rate = wp::index(io.qvel, world, c);
#endif
        const float moved = move[0] * w[3] + move[1] * w[4] + move[2] * w[5];
        WP_PRAGMA_UNROLL
        for (int side = 0; side < 2; ++side) {
          const float *t = turn[side];
          const float one = moved + (t[0] * w[0] + t[1] * w[1] + t[2] * w[2]);
          if (moves[side] >> c & 1) value[j] += side ? one : -one;
        }
        speed += value[j] * rate;
      }
#ifdef __CUDA_ARCH__
      *reinterpret_cast<float4 *>(J + quad) = make_float4(value[0], value[1], value[2], value[3]);
#else
      for (int j = 0; j < 4; ++j) J[quad + j] = value[j];
#endif
    }

    // Reference and weight
    const bool own = k > 0 && (friction_ref[0] != 0.0f || friction_ref[1] != 0.0f);
    const auto ref = own ? friction_ref : normal_ref;
    const float least_time = io.disableflags & REFSAFE ? ref[0] : wp::max(ref[0], 2.0f * timestep);
    const float damping = ref[1] <= 0.0f ? -ref[1] / wp::max(TINY, high)
                                         : 2.0f / wp::max(TINY, high * least_time);
    float aref = -damping * speed, scale = 1.0f;
    if (k == 0) {
      const float stiffness =
          ref[0] <= 0.0f ? -ref[0] / wp::max(TINY, high * high)
                         : 1.0f / wp::max(TINY, high * high * least_time * least_time * ref[1] * ref[1]);
      aref = -stiffness * impedance * distance - damping * speed;
    } else {
      const auto &friction = io.contact_friction.data[con];
      const float ratio = friction[0] / friction[k - 1];
      scale = impratio * impratio * (k > 1 ? ratio * ratio : 1.0f);
    }
    wp::index(io.efc_D, world, r) = D / scale;
    wp::index(io.efc_aref, world, r) = aref;
    wp::index(io.efc_vel, world, r) = speed;
    wp::index(io.efc_pos, world, r) = (k ? 0.0f : distance) + margin;
    wp::index(io.efc_margin, world, r) = margin;
    wp::index(io.efc_frictionloss, world, r) = 0.0f;
    wp::index(io.efc_type, world, r) = dim == 1 ? FRICTIONLESS : ELLIPTIC;
    wp::index(io.efc_id, world, r) = con;
  }
}
