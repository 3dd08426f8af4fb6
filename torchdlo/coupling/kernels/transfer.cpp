// Particles and grid nodes with quadratic B-splines: what moves at the nodes, and what particles take back behind the
// walls of the box, with the derivatives. One scene per thread, sums always in the same order.
//
// at (scenes, 3, count): places in units of the node spacing, from the first node.
// value (scenes, 4, count), slope (scenes, 9, count): four values c and the slopes S of the first three of them,
//   row by row; what a particle says at a node that lies d from it is c + S d.
// vel (scenes, nodes, 3), mass (scenes, nodes): nodes in the order x, y, z, the last one fastest.
// origin (scenes, 3), friction (scenes): number of the first node, and coefficient at walls.
//
// Most nodes have no matter: only the block of those about particles is worked on, in memory that stays in the cache;
// backward it is made again.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "flush.h"
#include "walls.h"

struct Sizes {
  int64_t scenes, count, margin;
  const int64_t *size, *whole, *kinds;  // nodes that are computed and of the box along each axis; six of `Kind`
};

template <typename T>
struct Lanes;
template <>
struct Lanes<float> {
  typedef float type __attribute__((vector_size(16), aligned(4), may_alias));
  typedef float pair __attribute__((vector_size(32), aligned(4), may_alias));
};
template <>
struct Lanes<double> {
  typedef double type __attribute__((vector_size(32), aligned(8), may_alias));
  typedef double pair __attribute__((vector_size(64), aligned(8), may_alias));
};
template <typename T>
using Four = typename Lanes<T>::type;
template <typename T>
using Eight = typename Lanes<T>::pair;

#if defined(__has_builtin)
#if __has_builtin(__builtin_shufflevector)
#define SHUFFLE __builtin_shufflevector
#endif
#endif
template <typename T>
static inline Eight<T> pair(const Four<T>& a, const Four<T>& b) {
#ifdef SHUFFLE
  return SHUFFLE(a, b, 0, 1, 2, 3, 4, 5, 6, 7);
#else
  return Eight<T>{a[0], a[1], a[2], a[3], b[0], b[1], b[2], b[3]};
#endif
}
template <typename T>
static inline Eight<T> twice(const T* from) {
  const Four<T> a = *(const Four<T>*)from;
  return pair<T>(a, a);
}
template <typename T>
static inline Four<T> first(const Eight<T>& a) {
#ifdef SHUFFLE
  return SHUFFLE(a, a, 0, 1, 2, 3);
#else
  return Four<T>{a[0], a[1], a[2], a[3]};
#endif
}
template <typename T>
static inline Four<T> last(const Eight<T>& a) {
#ifdef SHUFFLE
  return SHUFFLE(a, a, 4, 5, 6, 7);
#else
  return Four<T>{a[4], a[5], a[6], a[7]};
#endif
}

// Number of the first of the three nodes about a place along an axis. Particles that left the grid take its border; NaN
// compares false and takes the first node.
template <typename T>
static inline int64_t base_of(T x, int64_t size) {
  const T most = T(size - 3), b = std::floor(x - T(0.5));
  return b > 0 ? (b < most ? int64_t(b) : int64_t(most)) : 0;
}

template <typename T>
struct Stencil {
  int64_t first;  // node with the lowest numbers of the 27
  T d[3][3];      // distance along each axis
  T w[3][3];      // weight
  T g[3][3];      // derivative of the weight by the particle's place

  Stencil(const T* at, int64_t count, const int64_t* size) {
    int64_t base[3];
    for (int a = 0; a < 3; ++a) {
      const T x = at[a * count];
      base[a] = base_of(x, size[a]);
      const T f = x - T(base[a]);
      w[a][0] = T(0.5) * (T(1.5) - f) * (T(1.5) - f);
      w[a][1] = T(0.75) - (f - 1) * (f - 1);
      w[a][2] = T(0.5) * (f - T(0.5)) * (f - T(0.5));
      g[a][0] = f - T(1.5);
      g[a][1] = 2 - 2 * f;
      g[a][2] = f - T(0.5);
      for (int i = 0; i < 3; ++i) d[a][i] = T(i) - f;
    }
    first = (base[0] * size[1] + base[1]) * size[2] + base[2];
  }
};

template <typename T>
static inline void load(const T* value, const T* slope, int64_t count, Four<T>& c, Four<T>* s) {
  c = Four<T>{value[0], value[count], value[2 * count], value[3 * count]};
  for (int a = 0; a < 3; ++a) s[a] = Four<T>{slope[a * count], slope[(3 + a) * count], slope[(6 + a) * count], T(0)};
}

template <typename T>
static inline void spread(const Stencil<T>& n, const Four<T>& c, const Four<T>* s, T* grid, const int64_t* size) {
  // The first two nodes of a row at once.
  const Eight<T> w = pair<T>(Four<T>{} + n.w[2][0], Four<T>{} + n.w[2][1]);
  const Eight<T> d = pair<T>(Four<T>{} + n.d[2][0], Four<T>{} + n.d[2][1]);
  const Eight<T> c2 = pair<T>(c, c), sx = pair<T>(s[0], s[0]), sy = pair<T>(s[1], s[1]), sz = pair<T>(s[2], s[2]);
  for (int i = 0; i < 3; ++i) {
    const Eight<T> ci = c2 + sx * n.d[0][i];
    for (int j = 0; j < 3; ++j) {
      const T wij = n.w[0][i] * n.w[1][j];
      const Eight<T> cij = (ci + sy * n.d[1][j]) * wij, sij = sz * wij;
      T* to = grid + 4 * (n.first + (i * size[1] + j) * size[2]);
      *(Eight<T>*)to += (cij + sij * d) * w;
      *(Four<T>*)(to + 8) += (first<T>(cij) + first<T>(sij) * n.d[2][2]) * n.w[2][2];
    }
  }
}

template <typename T>
static void spread(const T* at, const T* value, const T* slope, T* grid, int64_t count, const int64_t* size) {
  for (int64_t p = 0; p < count; ++p) {
    Four<T> c, s[3];
    load(value + p, slope + p, count, c, s);
    spread<T>(Stencil<T>(at + p, count, size), c, s, grid, size);
  }
}

// Sums over the 27 nodes of their values times weights and more, for each of the four values: `sum` with the weights,
// `by[a]` with distances along an axis, `slope[a]` with derivatives by the place along an axis, `both[a][b]` with the
// derivative along a and the distance along b, which itself is not differentiated.
template <typename T>
struct Moments {
  Four<T> sum{}, by[3] = {}, slope[3] = {}, both[3][3] = {};
};

// Axis by axis, the last one first. In a pair, the second has distances of the last axis as factors.
template <typename T, bool SLOPES>
static inline Moments<T> moments(const Stencil<T>& n, const T* grid, const int64_t* size) {
  Eight<T> w2[3], g2[3];
  for (int k = 0; k < 3; ++k) {
    w2[k] = pair<T>(Four<T>{} + n.w[2][k], Four<T>{} + n.w[2][k] * n.d[2][k]);
    g2[k] = pair<T>(Four<T>{} + n.g[2][k], Four<T>{} + n.g[2][k] * n.d[2][k]);
  }
  Moments<T> m;
  Eight<T> www{}, gww{}, wgw{}, wwg{};
  for (int i = 0; i < 3; ++i) {
    Eight<T> ww{}, gw{}, wg{};
    Four<T> dw{}, gdw{}, dg{};
    for (int j = 0; j < 3; ++j) {
      const T* from = grid + 4 * (n.first + (i * size[1] + j) * size[2]);
      const T w = n.w[1][j], g = n.g[1][j], d = n.d[1][j];
      const Eight<T> a = twice<T>(from), b = twice<T>(from + 4), c = twice<T>(from + 8);
      const Eight<T> plain = a * w2[0] + b * w2[1] + c * w2[2];
      ww += plain * w, dw += first<T>(plain) * (w * d);
      if (SLOPES) {
        const Eight<T> steep = a * g2[0] + b * g2[1] + c * g2[2];
        gw += plain * g, gdw += first<T>(plain) * (g * d);
        wg += steep * w, dg += first<T>(steep) * (w * d);
      }
    }
    const T w = n.w[0][i], g = n.g[0][i], d = n.d[0][i];
    www += ww * w;
    m.by[0] += first<T>(ww) * (w * d), m.by[1] += dw * w;
    if (SLOPES) {
      gww += ww * g, m.both[0][0] += first<T>(ww) * (g * d), m.both[0][1] += dw * g;
      wgw += gw * w, m.both[1][0] += first<T>(gw) * (w * d), m.both[1][1] += gdw * w;
      wwg += wg * w, m.both[2][0] += first<T>(wg) * (w * d), m.both[2][1] += dg * w;
    }
  }
  m.sum = first<T>(www), m.by[2] = last<T>(www);
  if (SLOPES) {
    m.slope[0] = first<T>(gww), m.both[0][2] = last<T>(gww);
    m.slope[1] = first<T>(wgw), m.both[1][2] = last<T>(wgw);
    m.slope[2] = first<T>(wwg), m.both[2][2] = last<T>(wwg);
  }
  return m;
}

template <typename T>
static inline void keep(const Moments<T>& m, T* value, T* slope, int64_t count) {
  for (int k = 0; k < 4; ++k) value[k * count] = m.sum[k];
  for (int k = 0; k < 3; ++k)
    for (int a = 0; a < 3; ++a) slope[(3 * k + a) * count] = m.by[a][k];
}

// Derivative of sum_i w_i (c + S d_i) . g_i by the particle's place; d_i loses what the place gains.
template <typename T>
static inline void tilt(const Moments<T>& m, const Four<T>& c, const Four<T>* s, T* out, int64_t count) {
  for (int a = 0; a < 3; ++a) {
    const Four<T> all = c * m.slope[a] + s[0] * m.both[a][0] + s[1] * m.both[a][1] + s[2] * m.both[a][2] - s[a] * m.sum;
    out[a * count] = all[0] + all[1] + all[2] + all[3];
  }
}

// The block of nodes about all particles of a scene.
struct Span {
  int64_t low[3], high[3], size[3];  // first and last node along each axis

  template <typename T>
  Span(const T* at, int64_t count, const int64_t* size) {
    for (int a = 0; a < 3; ++a) {
      int64_t least = size[a], most = 0;
      for (int64_t p = 0; p < count; ++p) {
        const int64_t b = base_of(at[a * count + p], size[a]);
        least = b < least ? b : least, most = b > most ? b : most;
      }
      low[a] = least, high[a] = most + 2, this->size[a] = size[a];
    }
  }
  // Calls with the numbers of a row of nodes along z: in x and y, and its first and last one.
  template <class F>
  void rows(F call) const {
    for (int64_t i = low[0]; i <= high[0]; ++i)
      for (int64_t j = low[1]; j <= high[1]; ++j) {
        const int64_t first = (i * size[1] + j) * size[2];
        call(i, j, first + low[2], first + high[2]);
      }
  }
  template <typename T>
  void clear(T* grid) const {
    rows([&](int64_t, int64_t, int64_t first, int64_t last) { std::fill(grid + 4 * first, grid + 4 * last + 4, T(0)); });
  }
  // Calls with every node and what it is behind, or nullptr if that is nothing; `origin` is that of the scene.
  template <typename T, class F>
  void nodes(const T* origin, const Sizes& n, F call) const {
    int behind[6];
    const auto look = [&](int axis, int64_t i) {
      const T number = origin[axis] + T(i);
      const bool lower = number <= T(n.margin), upper = number >= T(n.whole[axis] - 1 - n.margin);
      behind[2 * axis] = lower ? int(n.kinds[2 * axis]) : OPEN;
      behind[2 * axis + 1] = upper ? int(n.kinds[2 * axis + 1]) : OPEN;
      return behind[2 * axis] != OPEN || behind[2 * axis + 1] != OPEN;
    };
    rows([&](int64_t i, int64_t j, int64_t first, int64_t last) {
      const bool x = look(0, i), y = look(1, j);
      for (int64_t node = first; node <= last; ++node) {
        const bool z = look(2, node - first + low[2]);
        call(node, x || y || z ? behind : nullptr);
      }
    });
  }
};

// Memory for two grids of a scene, one per thread.
template <typename T>
static T* working(int64_t nodes, int which) {
  static thread_local std::vector<T> kept[2];
  if (int64_t(kept[which].size()) < 4 * nodes) kept[which].resize(4 * nodes);
  return kept[which].data();
}

#define SCENES _Pragma("omp parallel for num_threads(threads)") \
  for (int64_t b = 0; b < n.scenes; ++b) if (const FlushTiny flush; true)
#define NODES const int64_t nodes = n.size[0] * n.size[1] * n.size[2], count = n.count

// Velocities of nodes, zero where there is no mass, and masses.
template <typename T>
static void give(const T* at, const T* value, const T* slope, T* vel, T* mass, const Sizes& n, int threads) {
  NODES;
  SCENES {
    T *grid = working<T>(nodes, 0), *v = vel + 3 * b * nodes, *m = mass + b * nodes;
    const Span span(at + 3 * b * count, count, n.size);
    span.clear(grid);
    spread<T>(at + 3 * b * count, value + 4 * b * count, slope + 9 * b * count, grid, count, n.size);
    std::fill(v, v + 3 * nodes, T(0)), std::fill(m, m + nodes, T(0));
    span.rows([&](int64_t, int64_t, int64_t first, int64_t last) {
      for (int64_t i = first; i <= last; ++i) {
        const T *g = grid + 4 * i;
        m[i] = g[3];
        for (int a = 0; a < 3; ++a) v[3 * i + a] = g[3] > 0 ? g[a] / g[3] : T(0);
      }
    });
  }
}

template <typename T>
static void give_back(const T* at, const T* value, const T* slope, const T* vel_by, const T* mass_by, T* dat, T* dvalue,
                      T* dslope, const Sizes& n, int threads) {
  NODES;
  SCENES {
    const T *x = at + 3 * b * count, *c = value + 4 * b * count, *s = slope + 9 * b * count;
    T *grid = working<T>(nodes, 0), *by = working<T>(nodes, 1);
    const Span span(x, count, n.size);
    span.clear(grid);
    spread<T>(x, c, s, grid, count, n.size);
    span.rows([&](int64_t, int64_t, int64_t first, int64_t last) {
      for (int64_t i = first; i <= last; ++i) {
        const T *g = grid + 4 * i, *d = vel_by + 3 * (b * nodes + i);
        T *to = by + 4 * i, moved = 0;
        for (int a = 0; a < 3; ++a) {
          to[a] = g[3] > 0 ? d[a] / g[3] : T(0);
          moved += g[3] > 0 ? g[a] / g[3] * to[a] : T(0);
        }
        to[3] = mass_by[b * nodes + i] - moved;
      }
    });
    for (int64_t p = 0; p < count; ++p) {
      Four<T> value_p, slope_p[3];
      load(c + p, s + p, count, value_p, slope_p);
      const Moments<T> m = moments<T, true>(Stencil<T>(x + p, count, n.size), by, n.size);
      tilt<T>(m, value_p, slope_p, dat + 3 * b * count + p, count);
      keep<T>(m, dvalue + 4 * b * count + p, dslope + 9 * b * count + p, count);
    }
  }
}

// Velocities behind the walls, with a zero behind each.
template <typename T>
static void fill(const Span& span, const T* vel, const T* origin, T friction, T* grid, const Sizes& n) {
  span.nodes<T>(origin, n, [&](int64_t node, const int* behind) {
    const T* v = vel + 3 * node;
    T* to = grid + 4 * node;
    to[3] = 0;
    if (!behind) {
      to[0] = v[0], to[1] = v[1], to[2] = v[2];
      return;
    }
    const Stopped<T> s(v, behind, friction);
    for (int a = 0; a < 3; ++a) to[a] = s.share * s.left[a];
  });
}

// What particles see of the nodes behind the walls.
template <typename T>
static void take(const T* at, const T* vel, const T* origin, const T* friction, T* value, T* slope, const Sizes& n,
                 int threads) {
  NODES;
  SCENES {
    T* grid = working<T>(nodes, 0);
    const Span span(at + 3 * b * count, count, n.size);
    fill<T>(span, vel + 3 * b * nodes, origin + 3 * b, friction[b], grid, n);
    for (int64_t p = 0; p < count; ++p) {
      const Stencil<T> stencil(at + 3 * b * count + p, count, n.size);
      keep<T>(moments<T, false>(stencil, grid, n.size), value + 4 * b * count + p, slope + 9 * b * count + p, count);
    }
  }
}

template <typename T>
static void take_back(const T* at, const T* vel, const T* origin, const T* friction, const T* value_by,
                      const T* slope_by, T* dat, T* dvel, T* dfriction, const Sizes& n, int threads) {
  NODES;
  SCENES {
    const T *x = at + 3 * b * count, *c = value_by + 4 * b * count, *s = slope_by + 9 * b * count;
    const T* from = vel + 3 * b * nodes;
    T *grid = working<T>(nodes, 0), *by = working<T>(nodes, 1), *to = dvel + 3 * b * nodes, sum = 0;
    const Span span(x, count, n.size);
    fill<T>(span, from, origin + 3 * b, friction[b], grid, n);
    span.clear(by);
    for (int64_t p = 0; p < count; ++p) {
      Four<T> value_p, slope_p[3];
      load(c + p, s + p, count, value_p, slope_p);
      const Stencil<T> stencil(x + p, count, n.size);
      tilt<T>(moments<T, true>(stencil, grid, n.size), value_p, slope_p, dat + 3 * b * count + p, count);
      spread<T>(stencil, value_p, slope_p, by, n.size);
    }
    std::fill(to, to + 3 * nodes, T(0));
    span.nodes<T>(origin + 3 * b, n, [&](int64_t node, const int* behind) {
      const T* g = by + 4 * node;
      T* o = to + 3 * node;
      if (!behind) {
        o[0] = g[0], o[1] = g[1], o[2] = g[2];
        return;
      }
      stopped_back(Stopped<T>(from + 3 * node, behind, friction[b]), behind, friction[b], g, o, sum);
    });
    dfriction[b] = sum;
  }
}

#define ENTRY(T)                                                                                                    \
  extern "C" void transfer_##T##_give(const T* at, const T* value, const T* slope, T* vel, T* mass, const Sizes* n, \
                                      int threads) {                                                                \
    give<T>(at, value, slope, vel, mass, *n, threads);                                                              \
  }                                                                                                                 \
  extern "C" void transfer_##T##_give_back(const T* at, const T* value, const T* slope, const T* vel_by,            \
                                           const T* mass_by, T* dat, T* dvalue, T* dslope, const Sizes* n,          \
                                           int threads) {                                                           \
    give_back<T>(at, value, slope, vel_by, mass_by, dat, dvalue, dslope, *n, threads);                              \
  }                                                                                                                 \
  extern "C" void transfer_##T##_take(const T* at, const T* vel, const T* origin, const T* friction, T* value,      \
                                      T* slope, const Sizes* n, int threads) {                                      \
    take<T>(at, vel, origin, friction, value, slope, *n, threads);                                                  \
  }                                                                                                                 \
  extern "C" void transfer_##T##_take_back(const T* at, const T* vel, const T* origin, const T* friction,           \
                                           const T* value_by, const T* slope_by, T* dat, T* dvel, T* dfriction,     \
                                           const Sizes* n, int threads) {                                           \
    take_back<T>(at, vel, origin, friction, value_by, slope_by, dat, dvel, dfriction, *n, threads);                 \
  }
ENTRY(float)
ENTRY(double)
