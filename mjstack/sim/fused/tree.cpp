// What the kernels of the smooth dynamics share: positions.cpp, forces.cpp and advance.cpp follow it.
// A warp does a world.
//
// A world's arrays are read whole, lie in shared memory as floats while they are worked on, and are
// written whole: neighbouring threads read and write neighbouring floats.
//
// Constants: NBODY, NJNT, NGEOM, NSITE, NBRANCH (from a root to a leaf), NFREE free bodies, NV, NC
// elements of the inertia, NA actuators, NACT activations, NT fixed tendons, BLOCK degrees of
// freedom of the largest tree.

constexpr float PI = 3.14159265f;
const int world = warp;

struct V3 {
  float x, y, z;
  CUDA_CALLABLE V3 operator+(const V3 &o) const { return V3{x + o.x, y + o.y, z + o.z}; }
  CUDA_CALLABLE V3 operator-(const V3 &o) const { return V3{x - o.x, y - o.y, z - o.z}; }
  CUDA_CALLABLE V3 operator*(float s) const { return V3{x * s, y * s, z * s}; }
};
struct Quat {
  float w, x, y, z;
};
struct Spatial {  // angular, then linear
  V3 a, l;
  CUDA_CALLABLE Spatial operator+(const Spatial &o) const { return Spatial{a + o.a, l + o.l}; }
  CUDA_CALLABLE Spatial operator*(float s) const { return Spatial{a * s, l * s}; }
};

// Where a world's floats begin: of a result or state, and of a model's field, which worlds may share
auto of_world = [&](const auto &array) {
  return reinterpret_cast<float *>(reinterpret_cast<char *>(array.data) + (size_t)world * array.strides[0]);
};
auto field = [&](const auto &array) {
  const int row = array.shape[0] == 1 ? 0 : world % array.shape[0];
  return reinterpret_cast<const float *>(reinterpret_cast<char *>(array.data) + (size_t)row * array.strides[0]);
};
auto load = [&](const auto &array, int count, float *to) {
  const float *from = of_world(array);
  for (int e = lane; e < count; e += T) to[e] = from[e];
};
auto store = [&](const auto &array, int count, const float *from) {
  float *to = of_world(array);
  for (int e = lane; e < count; e += T) to[e] = from[e];
};

// Element i of an array of vectors, quaternions or spatial vectors
auto vec = [](const float *p, int i) { return V3{p[3 * i], p[3 * i + 1], p[3 * i + 2]}; };
auto quat = [](const float *p, int i) {
  return Quat{p[4 * i], p[4 * i + 1], p[4 * i + 2], p[4 * i + 3]};
};
auto spatial = [&](const float *p, int i) { return Spatial{vec(p, 2 * i), vec(p, 2 * i + 1)}; };
auto put = [](float *p, int i, const V3 &v) {
  p[3 * i] = v.x;
  p[3 * i + 1] = v.y;
  p[3 * i + 2] = v.z;
};
auto put_quat = [](float *p, int i, const Quat &q) {
  p[4 * i] = q.w;
  p[4 * i + 1] = q.x;
  p[4 * i + 2] = q.y;
  p[4 * i + 3] = q.z;
};
auto put_spatial = [&](float *p, int i, const Spatial &s) {
  put(p, 2 * i, s.a);
  put(p, 2 * i + 1, s.l);
};

auto dot = [](const V3 &a, const V3 &b) { return a.x * b.x + a.y * b.y + a.z * b.z; };
auto cross = [](const V3 &a, const V3 &b) {
  return V3{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
};
auto length = [&](const V3 &v) { return sqrtf(dot(v, v)); };
auto inner = [&](const Spatial &a, const Spatial &b) { return dot(a.a, b.a) + dot(a.l, b.l); };

auto product = [](const Quat &u, const Quat &v) {
  return Quat{u.w * v.w - u.x * v.x - u.y * v.y - u.z * v.z,
              u.w * v.x + u.x * v.w + u.y * v.z - u.z * v.y,
              u.w * v.y - u.x * v.z + u.y * v.w + u.z * v.x,
              u.w * v.z + u.x * v.y - u.y * v.x + u.z * v.w};
};
auto normalized = [](const Quat &q) {
  const float size = sqrtf(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
  if (size <= 0.0f) return Quat{0.0f, 0.0f, 0.0f, 1.0f};  // Warp's, whose last part is the real one
  const float inverse = 1.0f / size;  // NaN stays NaN
  return Quat{q.w * inverse, q.x * inverse, q.y * inverse, q.z * inverse};
};
auto rotated = [&](const V3 &v, const Quat &q) {
  const V3 u{q.x, q.y, q.z};
  return u * (2.0f * dot(u, v)) + v * (q.w * q.w - dot(u, u)) + cross(u, v) * (2.0f * q.w);
};
auto turn = [](const V3 &axis, float angle) {
  const float s = sinf(angle * 0.5f);
  return Quat{cosf(angle * 0.5f), axis.x * s, axis.y * s, axis.z * s};
};
auto put_matrix = [](float *p, int i, const Quat &q) {
  float *m = p + 9 * i;
  const float ww = q.w * q.w, wx = q.w * q.x, wy = q.w * q.y, wz = q.w * q.z;
  const float xx = q.x * q.x, xy = q.x * q.y, xz = q.x * q.z;
  const float yy = q.y * q.y, yz = q.y * q.z, zz = q.z * q.z;
  m[0] = ww + xx - yy - zz;
  m[1] = 2.0f * (xy - wz);
  m[2] = 2.0f * (xz + wy);
  m[3] = 2.0f * (xy + wz);
  m[4] = ww - xx + yy - zz;
  m[5] = 2.0f * (yz - wx);
  m[6] = 2.0f * (xz - wy);
  m[7] = 2.0f * (yz + wx);
  m[8] = ww - xx - yy + zz;
};

// Spatial inertia (MuJoCo's ten numbers) by a motion; cross products of motions, and with a force
auto momentum_of = [](const float *i, const Spatial &v) {
  const V3 &a = v.a, &l = v.l;
  return Spatial{V3{i[0] * a.x + i[3] * a.y + i[4] * a.z - i[8] * l.y + i[7] * l.z,
                    i[3] * a.x + i[1] * a.y + i[5] * a.z + i[8] * l.x - i[6] * l.z,
                    i[4] * a.x + i[5] * a.y + i[2] * a.z - i[7] * l.x + i[6] * l.y},
                 V3{i[8] * a.y - i[7] * a.z + i[9] * l.x, i[6] * a.z - i[8] * a.x + i[9] * l.y,
                    i[7] * a.x - i[6] * a.y + i[9] * l.z}};
};
auto cross_motion = [&](const Spatial &u, const Spatial &v) {
  return Spatial{cross(u.a, v.a), cross(u.l, v.a) + cross(u.a, v.l)};
};
auto cross_force = [&](const Spatial &v, const Spatial &f) {
  return Spatial{cross(v.a, f.a) + cross(v.l, f.l), cross(v.a, f.l)};
};

// A coefficient that depends on x, and the derivative of x times it
auto poly = [](float k, const float *p, float x) { return k + p[0] * x + p[1] * x * x; };
auto poly_slope = [](float k, const float *p, float x) {
  return k + 2.0f * p[0] * x + 3.0f * p[1] * x * x;
};

// What actuators add to element k, of `width`, of a coefficient of their joint or tendon, whose owner
// is -1 where none does
auto actuator_sum = [&](const auto &array, int width, int k, int owner, int target, bool tendon) {
  float total = 0.0f;
  for (int u = 0; owner != -1 && u < NA; ++u) {
    if (io.actuator_trnid.data[u][0] != target || (io.actuator_trntype.data[u] == TENDON) != tendon)
      continue;
    const float gear = field(io.actuator_gear)[6 * u];
    total += gear * gear * field(array)[width * u + k];
  }
  return total;
};

// Damping of element i of an array, a coefficient with its polynomial
struct Damping {
  float k, p[2];
};
auto damping_at = [&](const auto &k, const auto &p, int i, int owner, int target, bool tendon) {
  auto curve = [&](int e) {
    return field(p)[2 * i + e] + actuator_sum(io.actuator_dampingpoly, 2, e, owner, target, tendon);
  };
  return Damping{field(k)[i] + actuator_sum(io.actuator_damping, 1, 0, owner, target, tendon),
                 {curve(0), curve(1)}};
};
auto dof_damping = [&](int i) {
  const int joint = io.dof_jntid.data[i], owner = io.jnt_actuatorid.data[joint];
  return damping_at(io.dof_damping, io.dof_dampingpoly, i, owner, joint, false);
};
auto tendon_damping = [&](int t) {
  const int owner = io.tendon_actuatorid.data[t];
  return damping_at(io.tendon_damping, io.tendon_dampingpoly, t, owner, t, true);
};

// Tendons' lengths by the degrees of freedom, NV of each
auto load_pulls = [&](float *pull) {
  for (int e = lane; e < NT * NV; e += T) pull[e] = 0.0f;
  SYNC();
  for (int t = lane; t < NT; t += T) {
    const int from = io.ten_J_rowadr.data[t], end = from + io.ten_J_rownnz.data[t];
    for (int k = from; k < end; ++k) pull[t * NV + io.ten_J_colind.data[k]] = of_world(io.ten_J)[k];
  }
};

// An activation one step later
auto next_activation = [&](const auto &io, int u, float act, float rate, bool limited, float timestep) {
  if (io.actuator_dyntype.data[u] == FILTEREXACT) {
    const float tau = wp::max(TINY, field(io.actuator_dynprm)[10 * u]);
    act += rate * tau * (1.0f - expf(-timestep / tau));
  } else {
    act += rate * timestep;
  }
  const float *range = field(io.actuator_actrange) + 2 * u;
  return limited ? wp::clamp(act, range[0], range[1]) : act;
};

// Solves A y = x by L D L', all trees at once. A row of h has the columns from its tree's first
// degree of freedom on, LD at most. A thread has its rows in registers; of the others' it needs one
// column after the other.
constexpr int LD = BLOCK | 1;
constexpr int ROWS = (NV + T - 1) / T;
auto solve = [&](const int *first, float *h, float *x) {
  SHARED float columns[2][NV + BLOCK], rest[2][NV], inverse[NV];
  float a[ROWS][BLOCK], y[ROWS];
  WP_PRAGMA_UNROLL
  for (int r = 0; r < ROWS; ++r) {
    const int i = wp::min(lane + r * T, NV - 1);
    WP_PRAGMA_UNROLL
    for (int k = 0; k < BLOCK; ++k) a[r][k] = h[i * LD + k];
    y[r] = x[i];
  }
  for (int e = lane; e < 2 * BLOCK; e += T) columns[e / BLOCK][NV + e % BLOCK] = 0.0f;

  // L D, and L D y. Every second column has the same place, so one pause per column is enough.
  WP_PRAGMA_UNROLL
  for (int j = 0; j < BLOCK; ++j) {
    float *column = columns[j & 1], *known = rest[j & 1];
    WP_PRAGMA_UNROLL
    for (int r = 0; r < ROWS; ++r) {
      const int i = lane + r * T;
      if (i >= NV) continue;
      column[i] = a[r][j];
      known[i] = y[r];
      if (i == first[i] + j) inverse[i] = 1.0f / a[r][j];
    }
    SYNC();
    WP_PRAGMA_UNROLL
    for (int r = 0; r < ROWS; ++r) {
      const int i = lane + r * T;
      if (i >= NV || first[i] + j >= i) continue;
      const int pivot = first[i] + j;
      const float scale = a[r][j] * inverse[pivot];
      y[r] -= scale * known[pivot];
      // Columns beyond the diagonal hold numbers that no one uses.
      WP_PRAGMA_UNROLL
      for (int k = j + 1; k < BLOCK; ++k) a[r][k] -= scale * column[pivot - j + k];
    }
  }

  // L' y. An element is complete once all later ones of its tree have been taken out.
  for (int r = 0; r < ROWS; ++r) {
    const int i = lane + r * T;
    if (i >= NV) continue;
    WP_PRAGMA_UNROLL
    for (int k = 0; k < BLOCK; ++k) h[i * LD + k] = a[r][k];
    x[i] = y[r] * inverse[i];
  }
  SYNC();
  for (int j = BLOCK - 1; j > 0; --j) {
    for (int i = lane; i < NV; i += T) {
      const int later = first[i] + j;
      if (later > i && later < NV && first[later] == first[i])
        x[i] -= h[later * LD + i - first[i]] * inverse[i] * x[later];
    }
    SYNC();
  }
};
