// Walls of the box on the nodes of a grid, and their derivative; formulas as in walls.py. One scene per thread.
//
// vel (scenes, nodes, 3), origin (scenes, 3), friction (scenes), out (scenes, nodes, 4), whose last numbers are zero.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "flush.h"

enum Kind { OPEN, SEPARATE, SLIP, STICK };

struct Sizes {
  int64_t scenes;
  const int64_t *size, *whole, *kinds;  // nodes that are computed and of the box along each axis; six of `Kind`
  int64_t margin;
};

// Length; vectors as short as in physics/linalg/numerics.py count as zero.
template <typename T>
static inline T length(const T* a) {
  const T squared = a[0] * a[0] + a[1] * a[1] + a[2] * a[2], tiny = sizeof(T) == 8 ? T(1e-12) : T(1e-8);
  return squared <= tiny * tiny ? T(0) : std::sqrt(squared);
}

// What faces leave of a node's velocity and what they take; `behind` are the kinds of the two faces of each axis.
template <typename T>
struct Stopped {
  T left[3], lost[3], speed, press, raw, share;
  bool sticks = false;

  Stopped(const T* vel, const int* behind, T friction) {
    for (int a = 0; a < 3; ++a) {
      const int lower = behind[2 * a], upper = behind[2 * a + 1];
      const bool leaves = (lower == SEPARATE && vel[a] < 0) || (upper == SEPARATE && vel[a] > 0);
      left[a] = leaves || lower > SEPARATE || upper > SEPARATE ? T(0) : vel[a];
      lost[a] = leaves ? vel[a] : T(0);
      sticks = sticks || lower == STICK || upper == STICK;
    }
    speed = length(left), press = length(lost);
    raw = 1 - friction * press / (speed > 0 ? speed : T(1));
    share = sticks || raw < 0 ? T(0) : raw;
  }
};

// Calls with every node and what it is behind, or nullptr if that is nothing; `origin` is that of the scene.
template <typename T, class F>
static void each(const T* origin, const Sizes& n, F call) {
  int behind[6];
  const auto look = [&](int axis, int64_t i) {
    const T number = origin[axis] + T(i);
    const bool lower = number <= T(n.margin), upper = number >= T(n.whole[axis] - 1 - n.margin);
    behind[2 * axis] = lower ? int(n.kinds[2 * axis]) : OPEN;
    behind[2 * axis + 1] = upper ? int(n.kinds[2 * axis + 1]) : OPEN;
    return behind[2 * axis] != OPEN || behind[2 * axis + 1] != OPEN;
  };
  int64_t node = 0;
  for (int64_t i = 0; i < n.size[0]; ++i) {
    const bool x = look(0, i);
    for (int64_t j = 0; j < n.size[1]; ++j) {
      const bool y = look(1, j);
      for (int64_t k = 0; k < n.size[2]; ++k, ++node) {
        const bool z = look(2, k);
        call(node, x || y || z ? behind : nullptr);
      }
    }
  }
}

#define SCENES _Pragma("omp parallel for num_threads(threads)") \
  for (int64_t b = 0; b < n.scenes; ++b) if (const FlushTiny flush; true)

template <typename T>
static void act(const T* vel, const T* origin, const T* friction, T* out, const Sizes& n, int threads) {
  const int64_t nodes = n.size[0] * n.size[1] * n.size[2];
  SCENES {
    const T* from = vel + 3 * b * nodes;
    T* to = out + 4 * b * nodes;
    each<T>(origin + 3 * b, n, [&](int64_t node, const int* behind) {
      const T* v = from + 3 * node;
      T* o = to + 4 * node;
      o[3] = 0;
      if (!behind) {
        o[0] = v[0], o[1] = v[1], o[2] = v[2];
        return;
      }
      const Stopped<T> s(v, behind, friction[b]);
      for (int a = 0; a < 3; ++a) o[a] = s.share * s.left[a];
    });
  }
}

template <typename T>
static void back(const T* vel, const T* origin, const T* friction, const T* by, T* dvel, T* dfriction, const Sizes& n,
                 int threads) {
  const int64_t nodes = n.size[0] * n.size[1] * n.size[2];
  SCENES {
    T sum = 0;
    each<T>(origin + 3 * b, n, [&](int64_t node, const int* behind) {
      const T *v = vel + 3 * (b * nodes + node), *g = by + 4 * (b * nodes + node);
      T* o = dvel + 3 * (b * nodes + node);
      if (!behind) {
        o[0] = g[0], o[1] = g[1], o[2] = g[2];
        return;
      }
      const Stopped<T> s(v, behind, friction[b]);
      const T mu = friction[b], speed = s.speed > 0 ? s.speed : T(1);
      const T dshare = s.sticks || s.raw < 0 ? T(0) : g[0] * s.left[0] + g[1] * s.left[1] + g[2] * s.left[2];
      const T dpress = s.press > 0 ? -mu / (speed * s.press) * dshare : T(0);
      const T dspeed = s.speed > 0 ? mu * s.press / (speed * speed * speed) * dshare : T(0);
      sum -= s.press / speed * dshare;
      for (int a = 0; a < 3; ++a) {
        const bool leaves = s.lost[a] != 0, stays = behind[2 * a] <= SEPARATE && behind[2 * a + 1] <= SEPARATE;
        o[a] = leaves ? dpress * s.lost[a] : (stays ? s.share * g[a] + dspeed * s.left[a] : T(0));
      }
    });
    dfriction[b] = sum;
  }
}

#define ENTRY(T)                                                                                                   \
  extern "C" void walls_##T##_act(const T* vel, const T* origin, const T* friction, T* out, const Sizes* n,        \
                                  int threads) {                                                                   \
    act<T>(vel, origin, friction, out, *n, threads);                                                               \
  }                                                                                                                \
  extern "C" void walls_##T##_back(const T* vel, const T* origin, const T* friction, const T* by, T* dvel,         \
                                   T* dfriction, const Sizes* n, int threads) {                                    \
    back<T>(vel, origin, friction, by, dvel, dfriction, *n, threads);                                              \
  }
ENTRY(float)
ENTRY(double)
