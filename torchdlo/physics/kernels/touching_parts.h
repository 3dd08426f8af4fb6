// What an implicit substep of ropes that touch is made of; as `Touch`, `Pairs` and `LengthSystem` in Python.
#pragma once
#include <cstdint>
#include <vector>

#include "joint_points.h"

namespace {

struct Sizes {
  int64_t slots, scenes, families, bodies, pairs, half, tries;
  const int64_t *after, *of, *steps;  // next slots; body of each family of points or -1; Newton steps of each try
  const int32_t* order;
  const double *hardness, *law;  // law: turning, most, least, shift, dt, solved, round, far, leaving, stalled (2)
  Tied tied;
};

// Where a number is among the inputs, and how far it is from slot to slot, family to family and scene to scene.
struct Place {
  int64_t input, offset, slot, family, scene;
};
// Numbers of slots, of points, of pairs, and of how bodies resist; where corners of pairs are told (4, pairs, scenes).
struct Inputs {
  const Place *slots, *points, *pairs, *bodies;
  int64_t joints;             // which input has the numbers of joints, (scenes, numbers), or -1
  int64_t corner[4], scenes;  // offset, and from corner to corner, pair to pair, scene to scene; what their numbers count
};

// Numbers of a vertex and its edge.
template <typename T>
struct Slot {
  T rest, compliance, active, mask, give, hinge, swing, free, tension;
  T vertex[3], moved[3], force[3], start[3], lead[3], scale, origin[3];
};
template <typename T>
struct Point {
  T real, share, normal[3], tangent[3], radius, lever, wanted, given[3], mu, arm[3];
};
template <typename T>
struct Pair {
  T real, normal[3], radius, wanted, mu, corner[4][9];
};

// How points move with the ends of edges and with bodies, see `maps` in contact_penalty.py.
template <typename T>
struct Maps {
  T first[9], second[9], body[18];

  explicit Maps(const Point<T>& p) {
    const T *n = p.normal, *t = p.tangent, *r = p.arm;
    const T nt = n[0] * t[0] + n[1] * t[1] + n[2] * t[2], held = p.lever > T(0) ? p.radius : T(0);
    const T arm[9] = {0, -r[2], r[1], r[2], 0, -r[0], -r[1], r[0], 0};
    const T turn[9] = {0, -n[2], n[1], n[2], 0, -n[0], -n[1], n[0], 0};
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b) {
        const T one = T(a == b), swing = p.lever * (t[a] * n[b] - nt * one);
        first[3 * a + b] = (1 - p.share) * one - swing;
        second[3 * a + b] = p.share * one + swing;
        T across = turn[3 * a + b];
        for (int c = 0; c < 3; ++c) across -= turn[3 * a + c] * t[c] * t[b];
        body[6 * a + b] = -one;
        body[6 * a + 3 + b] = arm[3 * a + b] - held * across;
      }
  }
};

template <typename T>
struct Felt {
  T force[3], gradient[9], steep;
};

template <typename T>
void times(const T* m, const T* x, T* y, int columns) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < columns; ++j) y[i] += m[columns * i + j] * x[j];
}
// y += m^T x
template <typename T>
void back(const T* m, const T* x, T* y, int columns) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < columns; ++j) y[j] += m[columns * i + j] * x[i];
}

template <typename T>
struct State {
  std::vector<T> pos, impulse, bodies, joints;
};

}  // namespace
