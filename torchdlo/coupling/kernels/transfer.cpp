// Between particles and grid nodes with quadratic B-splines; one scene per thread, sums always in the same order.
//
// at (scenes, 3, count): places in units of the node spacing, from the first node.
// value (scenes, 4, count), slope (scenes, 9, count): four values c and the slopes S of the first three of them,
//   row by row; what a particle says at a node that lies d from it is c + S d.
// grid (scenes, nodes, 4): nodes in the order x, y, z, the last one fastest.
#include <cmath>
#include <cstdint>

#include "flush.h"

template <typename T>
struct Lanes;
template <>
struct Lanes<float> {
  typedef float type __attribute__((vector_size(16), aligned(4), may_alias));
};
template <>
struct Lanes<double> {
  typedef double type __attribute__((vector_size(32), aligned(8), may_alias));
};
template <typename T>
using Four = typename Lanes<T>::type;

template <typename T>
struct Stencil {
  int64_t first;  // node with the lowest numbers of the 27
  T d[3][3];      // distance along each axis
  T w[3][3];      // weight
  T g[3][3];      // derivative of the weight by the particle's place

  Stencil(const T* at, int64_t count, const int64_t* size) {
    int64_t base[3];
    for (int a = 0; a < 3; ++a) {
      // Particles that left the grid take its border; NaN compares false and takes the first node.
      const T x = at[a * count], most = T(size[a] - 3);
      const T b = std::floor(x - T(0.5));
      base[a] = b > 0 ? (b < most ? int64_t(b) : int64_t(most)) : 0;
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
static void spread(const T* at, const T* value, const T* slope, T* grid, int64_t count, const int64_t* size) {
  for (int64_t p = 0; p < count; ++p) {
    const Stencil<T> n(at + p, count, size);
    Four<T> c, s[3];
    load(value + p, slope + p, count, c, s);
    for (int i = 0; i < 3; ++i) {
      const Four<T> ci = c + s[0] * n.d[0][i];
      for (int j = 0; j < 3; ++j) {
        const T wij = n.w[0][i] * n.w[1][j];
        const Four<T> cij = (ci + s[1] * n.d[1][j]) * wij, sij = s[2] * wij;
        Four<T>* to = (Four<T>*)(grid + 4 * (n.first + (i * size[1] + j) * size[2]));
        for (int k = 0; k < 3; ++k) to[k] += (cij + sij * n.d[2][k]) * n.w[2][k];
      }
    }
  }
}

template <typename T>
static void collect(const T* at, const T* grid, T* value, T* slope, int64_t count, const int64_t* size) {
  for (int64_t p = 0; p < count; ++p) {
    const Stencil<T> n(at + p, count, size);
    Four<T> c{}, s[3] = {};
    for (int i = 0; i < 3; ++i) {
      Four<T> ci{}, sy{}, sz{};
      for (int j = 0; j < 3; ++j) {
        const Four<T>* from = (const Four<T>*)(grid + 4 * (n.first + (i * size[1] + j) * size[2]));
        const Four<T> a = from[0] * n.w[2][0], b = from[1] * n.w[2][1], e = from[2] * n.w[2][2];
        const Four<T> sum = (a + b + e) * n.w[1][j];
        ci += sum;
        sy += sum * n.d[1][j];
        sz += (a * n.d[2][0] + b * n.d[2][1] + e * n.d[2][2]) * n.w[1][j];
      }
      c += ci * n.w[0][i];
      s[0] += ci * (n.w[0][i] * n.d[0][i]);
      s[1] += sy * n.w[0][i];
      s[2] += sz * n.w[0][i];
    }
    for (int k = 0; k < 4; ++k) value[k * count + p] = c[k];
    for (int k = 0; k < 3; ++k)
      for (int a = 0; a < 3; ++a) slope[(3 * k + a) * count + p] = s[a][k];
  }
}

// Derivative of sum_i w_i (c + S d_i) . g_i by the particle's place; d_i loses what the place gains.
template <typename T>
static void tilt(const T* at, const T* value, const T* slope, const T* grid, T* out, int64_t count,
                 const int64_t* size) {
  for (int64_t p = 0; p < count; ++p) {
    const Stencil<T> n(at + p, count, size);
    Four<T> c, s[3], x{}, y{}, z{}, sum{};
    load(value + p, slope + p, count, c, s);
    for (int i = 0; i < 3; ++i) {
      const Four<T> ci = c + s[0] * n.d[0][i];
      for (int j = 0; j < 3; ++j) {
        const Four<T> cij = ci + s[1] * n.d[1][j];
        const Four<T>* from = (const Four<T>*)(grid + 4 * (n.first + (i * size[1] + j) * size[2]));
        Four<T> along{}, across{}, total{};
        for (int k = 0; k < 3; ++k) {
          const Four<T> g = from[k], said = (cij + s[2] * n.d[2][k]) * g;
          along += said * n.w[2][k];
          across += said * n.g[2][k];
          total += g * n.w[2][k];
        }
        x += along * (n.g[0][i] * n.w[1][j]);
        y += along * (n.w[0][i] * n.g[1][j]);
        z += across * (n.w[0][i] * n.w[1][j]);
        sum += total * (n.w[0][i] * n.w[1][j]);
      }
    }
    const Four<T> all[3] = {x - s[0] * sum, y - s[1] * sum, z - s[2] * sum};
    for (int a = 0; a < 3; ++a) out[a * count + p] = all[a][0] + all[a][1] + all[a][2] + all[a][3];
  }
}

// What moves at the nodes: grid holds momentum and mass, vel (scenes, nodes, 3), mass (scenes, nodes).
template <typename T>
static void divide(const T* grid, T* vel, T* mass, int64_t nodes) {
  for (int64_t i = 0; i < nodes; ++i) {
    const T m = mass[i] = grid[4 * i + 3];
    for (int a = 0; a < 3; ++a) vel[3 * i + a] = m > 0 ? grid[4 * i + a] / m : T(0);
  }
}

// Its derivative: `by` is that by the velocities, `mass_by` that by the masses.
template <typename T>
static void divide_back(const T* grid, const T* by, const T* mass_by, T* out, int64_t nodes) {
  for (int64_t i = 0; i < nodes; ++i) {
    const T *g = grid + 4 * i, *d = by + 3 * i;
    T moved = 0;
    for (int a = 0; a < 3; ++a) {
      out[4 * i + a] = g[3] > 0 ? d[a] / g[3] : T(0);
      moved += g[3] > 0 ? g[a] / g[3] * out[4 * i + a] : T(0);
    }
    out[4 * i + 3] = mass_by[i] - moved;
  }
}

#define SCENES _Pragma("omp parallel for num_threads(threads)") \
  for (int64_t b = 0; b < scenes; ++b) if (const FlushTiny flush; true)

template <typename T>
static void run(int which, const T* at, T* value, T* slope, T* grid, T* out, int64_t scenes, int64_t count,
                const int64_t* size, int threads) {
  const int64_t nodes = size[0] * size[1] * size[2];
  SCENES {
    const T* a = at + 3 * b * count;
    T *v = value + 4 * b * count, *s = slope + 9 * b * count, *g = grid + 4 * b * nodes;
    if (which == 0) spread<T>(a, v, s, g, count, size);
    if (which == 1) collect<T>(a, g, v, s, count, size);
    if (which == 2) tilt<T>(a, v, s, g, out + 3 * b * count, count, size);
  }
}

#define DIVIDE(T)                                                                                                  \
  extern "C" void transfer_divide_##T(const T* grid, T* vel, T* mass, int64_t scenes, int64_t nodes, int threads) {   \
    SCENES divide<T>(grid + 4 * b * nodes, vel + 3 * b * nodes, mass + b * nodes, nodes);                             \
  }                                                                                                                   \
  extern "C" void transfer_divide_back_##T(const T* grid, const T* by, const T* mass_by, T* out, int64_t scenes,      \
                                           int64_t nodes, int threads) {                                              \
    SCENES divide_back<T>(grid + 4 * b * nodes, by + 3 * b * nodes, mass_by + b * nodes, out + 4 * b * nodes, nodes); \
  }
DIVIDE(float)
DIVIDE(double)

extern "C" void transfer_float(int which, const float* at, float* value, float* slope, float* grid, float* out,
                               int64_t scenes, int64_t count, const int64_t* size, int threads) {
  run<float>(which, at, value, slope, grid, out, scenes, count, size, threads);
}

extern "C" void transfer_double(int which, const double* at, double* value, double* slope, double* grid, double* out,
                                int64_t scenes, int64_t count, const int64_t* size, int threads) {
  run<double>(which, at, value, slope, grid, out, scenes, count, size, threads);
}
