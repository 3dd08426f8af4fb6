// What walls of the box take of a node's velocity, and its derivative; formulas as in grid_boundaries.py.
#pragma once
#include <cmath>

enum Kind { OPEN, SEPARATE, SLIP, STICK };

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

// Derivatives by the velocity and, added to `dfriction`, by the friction, from that by share * left.
template <typename T>
static inline void stopped_back(const Stopped<T>& s, const int* behind, T mu, const T* by, T* dvel, T& dfriction) {
  const T speed = s.speed > 0 ? s.speed : T(1);
  const T dshare = s.sticks || s.raw < 0 ? T(0) : by[0] * s.left[0] + by[1] * s.left[1] + by[2] * s.left[2];
  const T dpress = s.press > 0 ? -mu / (speed * s.press) * dshare : T(0);
  const T dspeed = s.speed > 0 ? mu * s.press / (speed * speed * speed) * dshare : T(0);
  dfriction -= s.press / speed * dshare;
  for (int a = 0; a < 3; ++a) {
    const bool leaves = s.lost[a] != 0, stays = behind[2 * a] <= SEPARATE && behind[2 * a + 1] <= SEPARATE;
    dvel[a] = leaves ? dpress * s.lost[a] : (stays ? s.share * by[a] + dspeed * s.left[a] : T(0));
  }
}
