// MuJoCo's Newton solver. A warp does a world, or some warps do one with many rows.
//
// J stays where it is and is read through the L1 cache; all else of a world lies in shared memory.
//
// Constants: NV degrees of freedom, NVP columns of J with padding; worlds with more than FEWER rows
// are done, up to NJ; ITERATIONS and LS_ITERATIONS, WARMSTART.

constexpr int LD = NV | 1;            // rows of h begin in different banks of shared memory
constexpr int WIDTH = T < 32 ? T : 32;  // threads of a warp
constexpr int TEAM = T / WIDTH;       // warps of a world
constexpr int CHUNK = TEAM > 1 ? 64 : 32;  // rows of s
constexpr int QUADS = NVP / 4;        // columns by fours
constexpr int NB = (NV + 3) / 4;      // blocks of 4 x 4 along the Hessian's side
constexpr int BLOCKS = NB * (NB + 1) / 2;
constexpr int GROUPS = WIDTH > BLOCKS ? WIDTH / BLOCKS : 1;  // of a warp's threads, which share rows
constexpr int SHARE = (BLOCKS + WIDTH - 1) / WIDTH;            // blocks of a thread
constexpr int SPLIT = T > QUADS ? T / QUADS : 1;     // of the rows, for J' force
constexpr float NOISE = 8.0f * 1.1920929e-07f;       // of a sum of derivatives, relative

SHARED alignas(16) float h[(NV + 1) * LD];  // Hessian's lower triangle, and the gradient below it
SHARED alignas(16) float s[(CHUNK > SPLIT ? CHUNK : SPLIT) * NVP];
SHARED alignas(16) float search[NVP];
SHARED alignas(16) float acc[NVP];
SHARED float ma[NV], mv[NV], smooth[NV], qfrc[NV];
SHARED float jaref[NJ], jv[NJ];
// Of a row: in the update weight, direction and force; in the line search three coefficients.
SHARED float qa[NJ], qb[NJ], qc[NJ];
// A row's first row of its contact; contacts' first rows; rows with a weight
SHARED unsigned short head[NJ], item[NJ], active[NJ];
SHARED unsigned char state[NJ], dims[NJ];  // dims: rows of a row's contact, or 0
SHARED float sums_of_warps[TEAM * 9];
SHARED int counts[TEAM];

const int world = warp;
const int nefc = wp::min(io.efc_aref.shape[1], io.nefc.data[world]);
if (nefc <= FEWER || nefc > NJ) return;  // of another launch
const int thread = lane % WIDTH, member = lane / WIDTH;
const int ne = wp::min(nefc, io.ne.data[world]);
const int nf = io.nf.data[world];
const int contacts = wp::min(nefc, ne + nf + io.nl.data[world]);  // where their rows begin
const float *J = &wp::index(io.efc_J, world, 0, 0);
const float *D = &wp::index(io.efc_D, world, 0);
const float *M = &wp::index(io.M, world, 0);
const float *loss = &wp::index(io.efc_frictionloss, world, 0);
const int *type = &wp::index(io.efc_type, world, 0);
const int *id = &wp::index(io.efc_id, world, 0);
const float impratio = io.opt_impratio_invsqrt.data[world % io.opt_impratio_invsqrt.shape[0]];
const float tolerance = io.opt_tolerance.data[world % io.opt_tolerance.shape[0]];
const float ls_tolerance = io.opt_ls_tolerance.data[world % io.opt_ls_tolerance.shape[0]];

// Sums over the threads; each gets the same bits.
auto sum = [&](auto &values) {
#ifdef __CUDA_ARCH__
  for (auto &value : values)
    for (int offset = 16; offset; offset >>= 1) value += __shfl_xor_sync(~0u, value, offset);
  if constexpr (TEAM > 1) {
    int k = 0;
    if (thread == 0)
      for (auto &value : values) sums_of_warps[member * 9 + k++] = value;
    SYNC();
    k = 0;
    for (auto &value : values) {
      value = 0.0f;
      for (int other = 0; other < TEAM; ++other) value += sums_of_warps[other * 9 + k];
      ++k;
    }
    SYNC();
  }
#endif
};

// Lists those numbers between begin and end that are kept, in their order; returns their count.
auto compact = [&](int begin, int end, auto keep, unsigned short *list) {
  int count = 0;
  for (int from = begin; from < end; from += T) {
    const int r = from + lane;
    const bool listed = r < end && keep(r);
#ifdef __CUDA_ARCH__
    const unsigned mask = __ballot_sync(~0u, listed);
    int place = count + __popc(mask & ((1u << thread) - 1u));
    if constexpr (TEAM > 1) {
      if (thread == 0) counts[member] = __popc(mask);
      SYNC();
      for (int other = 0; other < TEAM; ++other) {
        if (other < member) place += counts[other];
        count += counts[other];
      }
      SYNC();
    } else {
      count += __popc(mask);
    }
    if (listed) list[place] = r;
#else
    if (listed) list[count++] = r;
#endif
  }
  SYNC();
  return count;
};

auto divide = [](float x, float y) { return x / (y != 0.0f ? y : TINY); };

// out = M x
auto multiply = [&](const float *x, float *out) {
  for (int i = lane; i < NV; i += T) {
    float total = 0.0f;
    for (int k = io.M_mulm_rowadr.data[i]; k < io.M_mulm_rowadr.data[i + 1]; ++k)
      total += M[io.M_mulm_madr.data[k]] * x[io.M_mulm_col.data[k]];
    out[i] = total;
  }
};

// J x of a row
auto row_dot = [&](int r, const float *x) {
  const float4 *row = reinterpret_cast<const float4 *>(J + r * NVP);
  const float4 *y = reinterpret_cast<const float4 *>(x);
  float total = 0.0f;
  for (int k = 0; k < NV / 4; ++k) {
    const float4 a = row[k], b = y[k];
    total += a.x * b.x;
    total += a.y * b.y;
    total += a.z * b.z;
    total += a.w * b.w;
  }
  for (int c = NV / 4 * 4; c < NV; ++c) total += J[r * NVP + c] * x[c];  // not the padding
  return total;
};

// Where the solver starts

float trace[1] = {0.0f};
for (int i = lane; i < NVP; i += T) {
  if (i < NV) {
    acc[i] = nefc > 0 && WARMSTART ? wp::index(io.qacc_warmstart, world, i) : wp::index(io.qacc_smooth, world, i);
    smooth[i] = wp::index(io.qfrc_smooth, world, i);
    trace[0] += M[io.M_rowadr.data[i] + io.M_rownnz.data[i] - 1];
  } else {
    acc[i] = 0.0f;
    search[i] = 0.0f;
  }
}
sum(trace);
const float scale = 1.0f / wp::max(TINY, trace[0]);
for (int r = lane; r < nefc; r += T) {
  int first = r, dim = 0;
  if (type[r] == ELLIPTIC) {
    first = wp::index(io.contact_efc_address, id[r], 0);
    dim = io.contact_dim.data[id[r]];
    // Of a contact with more rows than the buffer has left, none counts: the world is void.
    if (first < 0 || first + dim > nefc) first = NJ;
  }
  head[r] = first;
  dims[r] = dim;
  state[r] = SATISFIED;
  qa[r] = qb[r] = qc[r] = 0.0f;
}
SYNC();
for (int r = lane; r < nefc; r += T)
  jaref[r] = row_dot(r, acc) - wp::index(io.efc_aref, world, r);
multiply(acc, ma);
const int items =
    contacts + compact(contacts, nefc, [&](int r) { return head[r] == r; }, item);
auto row_of = [&](int i) { return i < contacts ? i : (int)item[i - contacts]; };

// Of four columns
auto scaled = [](float a, const float4 &x) { return float4{a * x.x, a * x.y, a * x.z, a * x.w}; };
auto added = [](const float4 &x, float a, const float4 &y) {
  return float4{x.x + a * y.x, x.y + a * y.y, x.z + a * y.z, x.w + a * y.w};
};

// Force, state and the Hessian's weights of all rows
auto update = [&]() {
  for (int i = lane; i < items; i += T) {
    const int r = row_of(i);
    const float d = D[r];
    const float x = jaref[r];
    if (dims[r]) {
      const int dim = dims[r];
      const auto &friction = io.contact_friction.data[id[r]];
      const float mu = friction[0] * impratio;
      const float n = x * mu;
      float tt = 0.0f;
      for (int k = 1; k < dim; ++k) {
        const float u = jaref[r + k] * friction[k - 1];
        tt += u * u;
      }
      const float t = tt <= 0.0f ? 0.0f : sqrtf(tt);  // NaN stays NaN
      if (n >= mu * t || (t <= 0.0f && n >= 0.0f)) {
        for (int k = 0; k < dim; ++k) {
          state[r + k] = SATISFIED;
          qa[r + k] = qc[r + k] = 0.0f;
        }
      } else if (mu * n + t <= 0.0f || (t <= 0.0f && n < 0.0f)) {
        for (int k = 0; k < dim; ++k) {
          state[r + k] = QUADRATIC;
          qa[r + k] = sqrtf(D[r + k]);
          qc[r + k] = -D[r + k] * jaref[r + k];
        }
      } else {
        // Of the cone's curvature, one part is along the residual, the other one across it, in the
        // tangent plane: as many rows as the contact has, and one less with two tangents.
        const float dm = divide(d, mu * mu * (1.0f + mu * mu));
        const float normal = -dm * (n - mu * t) * mu;
        const float pull = divide(normal, t);
        state[r] = CONE;
        qa[r] = sqrtf(dm) * mu;
        qb[r] = sqrtf(wp::max(0.0f, dm * (mu * mu - mu * n / t)));
        qc[r] = normal;
        for (int k = 1; k < dim; ++k) {
          const float u = jaref[r + k] * friction[k - 1];
          state[r + k] = CONE;
          qa[r + k] = friction[k - 1];
          qb[r + k] = u / t;
          qc[r + k] = -pull * u * friction[k - 1];
        }
      }
      continue;
    }
    const bool one_sided = i >= ne + nf;
    float force = -d * x;
    int now = QUADRATIC;
    if (one_sided) {
      if (x >= 0.0f) now = SATISFIED;
    } else if (i >= ne) {
      const float f = loss[r];
      const float rf = divide(f, d);
      if (x <= -rf) {
        now = LINEARNEG;
        force = f;
      } else if (x >= rf) {
        now = LINEARPOS;
        force = -f;
      }
    }
    state[r] = now;
    qa[r] = now == QUADRATIC ? sqrtf(d) : 0.0f;
    qc[r] = now == SATISFIED ? 0.0f : force;
  }
  SYNC();
  // qfrc_constraint = J' force, and the gradient
  for (int e = lane; e < QUADS * SPLIT; e += T) {
    float4 total = {0.0f, 0.0f, 0.0f, 0.0f};
#pragma unroll 4
    for (int r = e / QUADS; r < nefc; r += SPLIT)
      total = added(total, qc[r], reinterpret_cast<const float4 *>(J + r * NVP)[e % QUADS]);
    reinterpret_cast<float4 *>(s)[e] = total;
  }
  SYNC();
  float square[1] = {0.0f};
  for (int i = lane; i < NV; i += T) {
    float total = 0.0f;
    for (int part = 0; part < SPLIT; ++part) total += s[part * NVP + i];
    qfrc[i] = total;
    const float gradient = ma[i] - smooth[i] - total;
    h[NV * LD + i] = gradient;
    square[0] += gradient * gradient;
  }
  sum(square);
  return square[0];
};

// Four columns of row r of S: the Hessian is M + S' S.
auto weighted = [&](int r, int quad) {
  auto row = [&](int k) { return reinterpret_cast<const float4 *>(J + k * NVP)[quad]; };
  if (state[r] != CONE) return scaled(qa[r], row(r));
  const int r0 = head[r];
  const int dim = dims[r0];
  if (dim == 3 && r > r0) {
    const float a = qb[r0] * qb[r0 + 1] * qa[r0 + 2];
    return added(scaled(a, row(r0 + 2)), -qb[r0] * qb[r0 + 2] * qa[r0 + 1], row(r0 + 1));
  }
  // The tangents' part along the residual
  float4 along = scaled(qb[r0 + 1] * qa[r0 + 1], row(r0 + 1));
  WP_PRAGMA_UNROLL  // so that their loads do not wait for each other
  for (int k = 2; k < 6; ++k)
    if (k < dim) along = added(along, qb[r0 + k] * qa[r0 + k], row(r0 + k));
  if (r == r0) return scaled(qa[r0], added(row(r0), -1.0f, along));
  return scaled(qb[r0], added(scaled(qa[r], row(r)), -qb[r], along));
};

// A thread's blocks of the Hessian's lower triangle: their first rows and columns
const int group = GROUPS > 1 ? thread / BLOCKS : 0;
int block_row[SHARE], block_col[SHARE];
for (int o = 0; o < SHARE; ++o) {
  const int block = GROUPS > 1 ? thread % BLOCKS : thread + o * WIDTH;
  int i = 0;
  while ((i + 1) * (i + 2) / 2 <= block) ++i;
  block_row[o] = group < GROUPS && block < BLOCKS ? 4 * i : -1;
  block_col[o] = 4 * (block - i * (i + 1) / 2);
}

// The Newton direction: search = -H^-1 gradient; its square, and the gradient's decrement.
float search_square = 0.0f;
auto direction = [&]() {
  const int rows = compact(0, nefc, [&](int r) {
    if (state[r] == CONE) return !(r == head[r] + 2 && dims[r] == 3);
    return qa[r] != 0.0f;
  }, active);
  float part[SHARE][4][4] = {};
  for (int from = 0; from < rows; from += CHUNK) {
    const int n = wp::min(CHUNK, rows - from);
    for (int e = lane; e < n * QUADS; e += T)
      reinterpret_cast<float4 *>(s)[e] = weighted(active[from + e / QUADS], e % QUADS);
    SYNC();
    for (int o = 0; o < SHARE; ++o) {
      if (block_row[o] >= 0) {
        for (int r = group + GROUPS * member; r < n; r += GROUPS * TEAM) {
          const float4 a4 = *reinterpret_cast<const float4 *>(s + r * NVP + block_row[o]);
          const float4 b4 = *reinterpret_cast<const float4 *>(s + r * NVP + block_col[o]);
          const float a[4] = {a4.x, a4.y, a4.z, a4.w};
          const float b[4] = {b4.x, b4.y, b4.z, b4.w};
          for (int p = 0; p < 4; ++p)
            for (int q = 0; q < 4; ++q) part[o][p][q] += a[p] * b[q];
        }
      }
    }
    SYNC();
  }
  // The first group adds the others' parts, one warp after the other.
  for (int o = 0; o < SHARE; ++o)
    for (int p = 0; p < 4; ++p)
      for (int q = 0; q < 4; ++q)
        for (int g = 1; g < GROUPS; ++g) {
          const float other = FROM(part[o][p][q], (thread + g * BLOCKS) % 32);
          if (group == 0) part[o][p][q] += other;
        }
  for (int turn = 0; turn < TEAM; ++turn) {
    for (int o = 0; o < SHARE; ++o)
      for (int p = 0; p < 4; ++p)
        for (int q = 0; q < 4; ++q) {
          const int i = block_row[o] + p, j = block_col[o] + q;
          if (turn == member && group == 0 && block_row[o] >= 0 && j <= i && i < NV)
            h[i * LD + j] = turn ? h[i * LD + j] + part[o][p][q] : part[o][p][q];
        }
    SYNC();
  }
  for (int e = lane; e < io.M_colind.shape[0]; e += T)
    h[io.M_hinit_i.data[e] * LD + io.M_colind.data[e]] += M[e];
  SYNC();
  // Cholesky of h; the gradient as a last row becomes y = L^-1 gradient; then L'^-1 y.
  float squares[2] = {};
  float *y = h + NV * LD;
#ifdef __CUDA_ARCH__
  if constexpr (NV < 32) {
    // A row per thread of the first warp, in registers
    if (member == 0) {
      float a[NV], inverse = 0.0f;
      WP_PRAGMA_UNROLL
      for (int k = 0; k < NV; ++k) a[k] = thread <= NV ? h[thread * LD + k] : 0.0f;
      WP_PRAGMA_UNROLL
      for (int j = 0; j < NV; ++j) {
        const float scaled = rsqrtf(FROM(a[j], j));
        if (thread == j) inverse = scaled;
        a[j] *= scaled;
        WP_PRAGMA_UNROLL
        for (int k = j + 1; k < NV; ++k) a[k] -= a[j] * FROM(a[j], k);
      }
      WP_PRAGMA_UNROLL
      for (int k = 0; k < NV; ++k)
        if (thread <= NV) h[thread * LD + k] = a[k];
      __syncwarp();
      float rest = thread < NV ? y[thread] : 0.0f, x = 0.0f;
      squares[1] = rest * rest;
      WP_PRAGMA_UNROLL
      for (int j = NV - 1; j >= 0; --j) {
        const float solution = FROM(rest * inverse, j);
        if (thread == j) x = solution;
        if (thread < j) rest -= h[j * LD + thread] * solution;
      }
      if (thread < NV) search[thread] = -x;
      squares[0] = x * x;
    }
  } else
#endif
  {
    // Column by column, in shared memory; the diagonal keeps the inverses
    for (int j = 0; j < NV; ++j) {
      float inverse = 0.0f;
      for (int first = j; first <= NV; first += T) {
        const int i = first + lane;
        float value = 0.0f;
        if (i <= NV) {
          value = h[i * LD + j];
          for (int k = 0; k < j; ++k) value -= h[i * LD + k] * h[j * LD + k];
        }
        if (first == j) inverse = 1.0f / sqrtf(FROM(value, 0));
        if (i <= NV) h[i * LD + j] = i == j ? inverse : value * inverse;
      }
      SYNC();
    }
    for (int i = lane; i < NV; i += T) squares[1] += y[i] * y[i];
    for (int j = NV - 1; j >= 0; --j) {
      SYNC();
      const float x = y[j] * h[j * LD + j];
      for (int i = lane; i < j; i += T) y[i] -= h[j * LD + i] * x;
      if (lane == 0) {
        search[j] = -x;
        squares[0] += x * x;
      }
    }
  }
  SYNC();
  sum(squares);
  search_square = squares[0];
  return squares[1];
};

// Change of cost, its derivative and second derivative at a step alpha, of one constraint
struct Point {
  float cost = 0.0f, slope = 0.0f, curvature = 0.0f;
};
auto quadratic = [&](float x0, float v, float d, float a) {
  const float c = v * v * d;
  return Point{a * (v * d * x0 + 0.5f * a * c), v * d * x0 + a * c, c};
};
auto friction_point = [&](float x, float f, float rf, float v, float d) {
  if (-rf < x && x < rf) return Point{0.5f * d * x * x, v * d * x, v * v * d};
  if (x <= -rf) return Point{f * (-0.5f * rf - x), -f * v, 0.0f};
  return Point{f * (-0.5f * rf + x), f * v, 0.0f};
};

// A contact's numbers for the line search: the quadratic of all its rows; normal and its change;
// the tangent's residual, along the step and across it.
struct Contact {
  float mu, q0, q1, q2, u0, v0, across, along, speed, dm;
  float t0, r0, cost0;
  int state0;
};
auto prepare_contact = [&](int r) {
  const auto &friction = io.contact_friction.data[id[r]];
  const int dim = dims[r];
  const float mu = friction[0] * impratio;
  const float d = D[r], x = jaref[r], v = jv[r];
  float q0 = 0.5f * x * x * d, q1 = v * d * x, q2 = 0.5f * v * v * d;
  float uu = 0.0f, uv = 0.0f, vv = 0.0f, det = 0.0f;
  for (int k = 1; k < dim; ++k) {
    const float xk = jaref[r + k], vk = jv[r + k], dk = D[r + k];
    q0 += 0.5f * xk * dk * xk;
    q1 += vk * dk * xk;
    q2 += 0.5f * vk * dk * vk;
    const float u = xk * friction[k - 1], w = vk * friction[k - 1];
    uu += u * u;
    uv += u * w;
    vv += w * w;
    // Not uu vv - uv^2, which cancels
    for (int l = 1; l < k; ++l) {
      const float cross = u * jv[r + l] * friction[l - 1] - jaref[r + l] * friction[l - 1] * w;
      det += cross * cross;
    }
  }
  float along = 0.0f, speed = 0.0f, across = uu;
  if (vv > 0.0f) {
    speed = sqrtf(vv);
    along = uv / speed;
    across = det / vv;
  }
  qa[r] = q0;
  qb[r] = q1;
  qc[r] = q2;
  qa[r + 1] = x * mu;
  qb[r + 1] = v * mu;
  qc[r + 1] = across;
  qa[r + 2] = along;
  qb[r + 2] = speed;
  qc[r + 2] = d / (mu * mu * (1.0f + mu * mu));
};
auto contact_at = [&](int r) {
  Contact c;
  c.mu = io.contact_friction.data[id[r]][0] * impratio;
  c.q0 = qa[r];
  c.q1 = qb[r];
  c.q2 = qc[r];
  c.u0 = qa[r + 1];
  c.v0 = qb[r + 1];
  c.across = qc[r + 1];
  c.along = qa[r + 2];
  c.speed = qb[r + 2];
  c.dm = qc[r + 2];
  const float uu = c.along * c.along + c.across;
  c.t0 = uu <= 0.0f ? 0.0f : sqrtf(uu);
  c.r0 = c.cost0 = 0.0f;
  if (uu <= 0.0f) {
    c.state0 = c.u0 < 0.0f ? QUADRATIC : SATISFIED;
  } else if (c.u0 >= c.mu * c.t0) {
    c.state0 = SATISFIED;
  } else if (c.mu * c.u0 + c.t0 <= 0.0f) {
    c.state0 = QUADRATIC;
  } else {
    c.state0 = CONE;
    c.r0 = c.u0 - c.mu * c.t0;
    c.cost0 = 0.5f * c.dm * c.r0 * c.r0;
  }
  if (c.state0 == QUADRATIC) c.cost0 = c.q0;
  return c;
};
// Costs are differences from the step 0, formed without cancellation.
auto contact_point = [&](const Contact &c, float a) {
  const float n = c.u0 + a * c.v0;
  const float w = c.along + a * c.speed;
  const float tt = w * w + c.across;
  const float t = tt <= 0.0f ? 0.0f : sqrtf(tt);  // NaN stays NaN
  if (tt <= 0.0f ? n >= 0.0f : n >= c.mu * t) return Point{-c.cost0, 0.0f, 0.0f};
  const float a_q2 = a * c.q2;
  if (tt <= 0.0f || c.mu * n + t <= 0.0f) {
    float cost = a * (a_q2 + c.q1);
    if (c.state0 == CONE) {
      const float edge = c.mu * c.u0 + c.t0;
      cost += 0.5f * c.dm * edge * edge;
    } else if (c.state0 == SATISFIED) {
      cost = 0.5f * c.dm * (1.0f + c.mu * c.mu) * (n * n + wp::max(tt, 0.0f));
    }
    return Point{cost, 2.0f * a_q2 + c.q1, 2.0f * c.q2};
  }
  const float t1 = w * c.speed / t;
  const float t2 = c.across / tt * (c.speed * c.speed / t);
  const float r = n - c.mu * t;
  const float r1 = c.v0 - c.mu * t1;
  float cost = 0.5f * c.dm * r * r;
  if (c.state0 == CONE) {
    const float dt = a * c.speed * (c.along + w) / (t + c.t0);
    const float dr = a * c.v0 - c.mu * dt;
    cost = 0.5f * c.dm * dr * (2.0f * c.r0 + dr);
  } else if (c.state0 == QUADRATIC) {
    const float edge = c.mu * n + t;
    cost = a * (a_q2 + c.q1) - 0.5f * c.dm * edge * edge;
  }
  return Point{cost, c.dm * r * r1, c.dm * (r1 * r1 - c.mu * r * t2)};
};

// A thread's share of the points at N steps, over all constraints but equalities. The cost is the
// change from step 0, or all of it.
auto evaluate = [&](const auto &alphas, auto &sums, bool all = false) {
  constexpr int N = sizeof(alphas) / sizeof(float);
  for (int k = 0; k < 3 * N; ++k) sums[k] = 0.0f;
  auto add = [&](int k, const Point &p, float cost0) {
    sums[3 * k] += all ? p.cost + cost0 : p.cost;
    sums[3 * k + 1] += p.slope;
    sums[3 * k + 2] += p.curvature;
  };
  for (int i = ne + lane; i < items; i += T) {
    const int r = row_of(i);
    if (dims[r]) {
      const Contact c = contact_at(r);
      for (int k = 0; k < N; ++k) add(k, contact_point(c, alphas[k]), c.cost0);
      continue;
    }
    const float d = D[r], x0 = jaref[r], v = jv[r];
    if (i < ne + nf) {
      const float f = loss[r], rf = divide(f, d);
      const float cost0 = friction_point(x0, f, rf, v, d).cost;
      for (int k = 0; k < N; ++k) {
        Point p = friction_point(x0 + alphas[k] * v, f, rf, v, d);
        p.cost -= cost0;
        add(k, p, cost0);
      }
      continue;
    }
    const float q0 = 0.5f * d * x0 * x0;
    const float cost0 = x0 < 0.0f ? q0 : 0.0f;
    for (int k = 0; k < N; ++k) {
      Point p{-cost0, 0.0f, 0.0f};
      if (x0 + alphas[k] * v < 0.0f) {
        p = quadratic(x0, v, d, alphas[k]);
        p.cost += q0 - cost0;
      }
      add(k, p, cost0);
    }
  }
};

// Newton's iterations

int bits = 0;
int iteration = 0;
float alpha = 0.0f, improvement = 0.0f;
for (;; ++iteration) {
  const float gradient = scale * sqrtf(update());
  if (iteration > 0
      && (alpha == 0.0f || (improvement > 0.0f && scale * improvement < tolerance)
          || gradient < tolerance))
    break;
  const float decrement = direction();
  if (iteration > 0 && scale * 0.5f * decrement < tolerance) break;
  if (iteration == ITERATIONS) {
    if (ITERATIONS > 0) bits |= LIMIT_ITERATIONS;
    break;
  }

  // The step's M search and J search
  multiply(search, mv);
  for (int r = lane; r < nefc; r += T) jv[r] = row_dot(r, search);
  SYNC();
  for (int i = contacts + lane; i < items; i += T)
    if (dims[row_of(i)]) prepare_contact(row_of(i));
  SYNC();

  // Cost, slope and curvature of the rows at step 0; the smooth part's slope and half of its
  // curvature, equalities among it
  float start[5] = {};
  const float standstill[1] = {0.0f};
  evaluate(standstill, start, true);
  for (int i = lane; i < NV; i += T) {
    start[3] += search[i] * (ma[i] - smooth[i]);
    start[4] += 0.5f * search[i] * mv[i];
  }
  for (int r = lane; r < ne; r += T) {
    start[3] += jv[r] * D[r] * jaref[r];
    start[4] += 0.5f * jv[r] * D[r] * jv[r];
  }
  sum(start);
  const float g1 = start[3], g2 = start[4];
  const float gtol = wp::max(tolerance * ls_tolerance * sqrtf(search_square) / scale, 1e-6f);

  auto points = [&](const auto &alphas, auto &sums) {
    constexpr int N = sizeof(alphas) / sizeof(float);
    evaluate(alphas, sums);
    sum(sums);
    for (int k = 0; k < N; ++k) {
      const float a_g2 = alphas[k] * g2;
      sums[3 * k] += alphas[k] * (a_g2 + g1);
      sums[3 * k + 1] += 2.0f * a_g2 + g1;
      sums[3 * k + 2] += 2.0f * g2;
    }
  };
  // Below the rounding of the slope's sum, by Cauchy and Schwarz, there is no descent to be seen.
  const float gross = sqrtf(2.0f * wp::max(start[0], 0.0f) * wp::max(start[2], 0.0f)) + fabsf(g1);
  const float accepted = wp::max(gtol, NOISE * gross);
  const Point p0{0.0f, g1 + start[1], 2.0f * g2 + start[2]};
  alpha = improvement = 0.0f;
  bool converged = fabsf(p0.slope) < NOISE * gross;
  const float newton[1] = {-divide(p0.slope, p0.curvature)};
  Point p1;
  if (!converged) {
    float sums[3];
    points(newton, sums);
    p1 = Point{sums[0], sums[1], sums[2]};
    if (fabsf(p1.slope) < accepted && p1.cost < 0.0f) {
      converged = true;
      alpha = newton[0];
      improvement = -p1.cost;
    }
  }
  if (!converged) {
    // A bracket about the minimum, made smaller by Newton steps from both ends and by its middle
    const bool less = p1.slope < p0.slope;
    Point lo = less ? p1 : p0, hi = less ? p0 : p1;
    float lo_alpha = less ? newton[0] : 0.0f, hi_alpha = less ? 0.0f : newton[0];
    auto inside = [](const Point &x, const Point &y) {
      return (x.slope < y.slope && y.slope < 0.0f) || (x.slope > y.slope && y.slope > 0.0f);
    };
    for (int k = 0; k < LS_ITERATIONS && !converged; ++k) {
      const float at[3] = {lo_alpha - divide(lo.slope, lo.curvature),
                           hi_alpha - divide(hi.slope, hi.curvature), 0.5f * (lo_alpha + hi_alpha)};
      float sums[9];
      points(at, sums);
      Point next[3];
      bool accepts = false, swapped = false;
      Point best{1e10f, 0.0f, 0.0f};
      float best_alpha = 0.0f;
      for (int c = 0; c < 3; ++c) {
        next[c] = Point{sums[3 * c], sums[3 * c + 1], sums[3 * c + 2]};
        if (fabsf(next[c].slope) < accepted && next[c].cost < 0.0f) {
          accepts = true;
          if (next[c].cost < best.cost) {
            best = next[c];
            best_alpha = at[c];
          }
        }
      }
      if (accepts) {
        lo = hi = best;
        lo_alpha = hi_alpha = best_alpha;
      } else {
        const int for_lo[3] = {0, 2, 1}, for_hi[3] = {1, 2, 0};
        for (int c : for_lo)
          if (inside(lo, next[c])) {
            lo = next[c];
            lo_alpha = at[c];
            swapped = true;
          }
        for (int c : for_hi)
          if (inside(hi, next[c]) || (c == 1 && hi.slope < 0.0f && next[c].slope > 0.0f)) {
            hi = next[c];
            hi_alpha = at[c];
            swapped = true;
          }
      }
      if (lo.cost < 0.0f || hi.cost < 0.0f) {
        alpha = lo.cost < hi.cost ? lo_alpha : hi_alpha;
        improvement = -wp::min(lo.cost, hi.cost);
      }
      converged = accepts || !swapped || (lo.cost < 0.0f && lo.slope < 0.0f && lo.slope > -gtol)
                  || (hi.cost < 0.0f && hi.slope > 0.0f && hi.slope < gtol);
    }
    if (!converged) bits |= LIMIT_LS_ITERATIONS;
  }

  // The step
  for (int i = lane; i < NV; i += T) {
    acc[i] += alpha * search[i];
    ma[i] += alpha * mv[i];
  }
  // All have read the rows by now: alpha came from every thread's sum.
  for (int r = lane; r < nefc; r += T) jaref[r] += alpha * jv[r];
  SYNC();
}

// What later stages read

for (int i = lane; i < NV; i += T) {
  wp::index(io.qacc, world, i) = acc[i];
  wp::index(io.qfrc_constraint, world, i) = qfrc[i];
  wp::index(io.efc_Ma, world, i) = ma[i];
}
for (int r = lane; r < nefc; r += T) {
  wp::index(io.efc_force, world, r) = qc[r];
  wp::index(io.efc_state, world, r) = state[r];
}
if (lane == 0) {
  io.solver_niter.data[world] = iteration;
  if (bits) io.overflow.data[world] |= bits;
}
