// One implicit substep of ropes that touch by Newton's method, one scene after the other, and its derivative.
//
// The formulas stand in contact_step.py, contact_penalty.py and edge_lengths.py, as tensor operations.
#include <cstdint>
#include <cstring>
#include <vector>

#include "flush.h"
#include "touching_back.h"
#include "touching_solve.h"

namespace {

// Reads numbers of structs behind each other, in a family and a scene.
template <typename T, class S>
void gather(S* to, int64_t count, const T* const* in, const Place* places, int64_t family, int64_t scene) {
  constexpr int64_t wide = sizeof(S) / sizeof(T);
  for (int64_t k = 0; k < wide; ++k) {
    const Place& p = places[k];
    const T* from = in[p.input] + p.offset + family * p.family + scene * p.scene;
    T* at = (T*)to + k;
    for (int64_t i = 0; i < count; ++i) at[i * wide] = from[i * p.slot];
  }
}

// A scene as `Scene` reads it.
template <typename T>
struct Given {
  std::vector<Slot<T>> slots;
  std::vector<Point<T>> points;
  std::vector<Pair<T>> pairs;
  std::vector<int64_t> corners;
  std::vector<T> inertia;

  explicit Given(const Sizes& s)
      : slots(s.slots), points(s.families * s.slots), pairs(s.pairs), corners(4 * s.pairs), inertia(36 * s.bodies) {}

  void read(const T* const* in, const int64_t* at, const Inputs& n, const Sizes& s, int64_t b, Scene<T>& scene) {
    const int64_t v = s.slots;
    gather(slots.data(), v, in, n.slots, 0, b);
    for (int64_t f = 0; f < s.families; ++f) gather(&points[f * v], v, in, n.points, f, b);
    const Place& real = n.pairs[0];
    for (int64_t q = 0; q < s.pairs; ++q) {
      pairs[q].real = in[real.input][real.offset + q * real.slot + b * real.scene];
      if (!(pairs[q].real > T(0))) continue;
      for (int64_t k = 1; k < int64_t(sizeof(Pair<T>) / sizeof(T)); ++k) {
        const Place& p = n.pairs[k];
        ((T*)&pairs[q])[k] = in[p.input][p.offset + q * p.slot + b * p.scene];
      }
      for (int m = 0; m < 4; ++m)
        corners[4 * q + m] = at[n.corner[0] + m * n.corner[1] + q * n.corner[2] + b * n.corner[3]] / n.scenes;
    }
    for (int64_t j = 0; j < s.bodies; ++j)
      for (int64_t k = 0; k < 36; ++k) {
        const Place& p = n.bodies[k];
        inertia[36 * j + k] = in[p.input][p.offset + j * p.slot + b * p.scene];
      }
    scene.slot = slots.data(), scene.points = points.data(), scene.pairs = pairs.data();
    scene.corners = corners.data(), scene.inertia = inertia.data();
    if (n.joints >= 0) scene.joints.numbers = in[n.joints] + b * (9 * s.tied.count + 13 * s.bodies);
  }
};

// Batches stand innermost in what comes out, as in all storage.
template <typename T>
void run(const T* const* in, const int64_t* at, const Inputs& n, T* const* out, const Sizes& s, int threads) {
  const int64_t v = s.slots, scenes = s.scenes, J = 6 * s.bodies, A = 3 * s.tied.count;
  const int64_t counts[13] = {3 * v, v, J, 1, 3 * v, v, 3 * v, 3 * v, J, 1, A, A, J};
#pragma omp parallel num_threads(threads) if (threads > 1 && scenes > 1)
  {
    const FlushTiny flush;
    Scene<T> scene(s);
    Given<T> given(s);
    std::vector<T> found[13];
    for (int r = 0; r < 13; ++r) found[r].resize(counts[r] + 1);
#pragma omp for schedule(dynamic)
    for (int64_t b = 0; b < scenes; ++b) {
      given.read(in, at, n, s, b, scene);
      T* f[13];
      for (int r = 0; r < 13; ++r) f[r] = found[r].data();
      scene(f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8], f[9], f[10], f[11], f[12]);
      for (int r = 0; r < 13; ++r)
        for (int64_t i = 0; i < counts[r]; ++i) out[r][i * scenes + b] = found[r][i];
    }
  }
}

// States and derivatives by results come as (B, ...), derivatives by slots go as (numbers, V, B), those by points, pairs
// and bodies as (B, ..., numbers).
template <typename T>
void back_run(const T* const* in, const int64_t* at, const Inputs& n, const T* const* found, T* const* out, const Sizes& s,
              int threads) {
  const int64_t v = s.slots, scenes = s.scenes, J = 6 * s.bodies;
  constexpr int64_t S = sizeof(Slot<T>) / sizeof(T);
#pragma omp parallel num_threads(threads) if (threads > 1 && scenes > 1)
  {
    const FlushTiny flush;
    Scene<T> scene(s);
    Given<T> given(s);
    std::vector<Slot<T>> slots(v);
#pragma omp for schedule(static, 8)
    for (int64_t b = 0; b < scenes; ++b) {
      given.read(in, at, n, s, b, scene);
      State<T> state{{found[0] + 3 * v * b, found[0] + 3 * v * (b + 1)},
                     {found[1] + v * b, found[1] + v * (b + 1)},
                     {found[2] + J * b, found[2] + J * (b + 1)}};
      std::memset((void*)slots.data(), 0, v * sizeof(Slot<T>));
      scene.backward(state, found[3][b], found[4] + 3 * v * b, found[5] + v * b, found[6] + 3 * v * b,
                     found[7] + 3 * v * b, found[8] + J * b,
                     {slots.data(), (Point<T>*)out[1] + b * s.families * v, (Pair<T>*)out[2] + b * s.pairs, out[3] + 6 * J * b});
      for (int64_t k = 0; k < S; ++k)
        for (int64_t i = 0; i < v; ++i) out[0][(k * v + i) * scenes + b] = ((const T*)&slots[i])[k];
    }
  }
}

}  // namespace

extern "C" {
void touching_float(const float* const* in, const int64_t* at, const Inputs* n, float* const* out, const Sizes* s,
                    int threads) {
  run<float>(in, at, *n, out, *s, threads);
}
void touching_double(const double* const* in, const int64_t* at, const Inputs* n, double* const* out, const Sizes* s,
                     int threads) {
  run<double>(in, at, *n, out, *s, threads);
}
void touching_back_float(const float* const* in, const int64_t* at, const Inputs* n, const float* const* found,
                         float* const* out, const Sizes* s, int threads) {
  back_run<float>(in, at, *n, found, out, *s, threads);
}
void touching_back_double(const double* const* in, const int64_t* at, const Inputs* n, const double* const* found,
                         double* const* out, const Sizes* s, int threads) {
  back_run<double>(in, at, *n, found, out, *s, threads);
}
}
