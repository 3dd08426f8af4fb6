// Reference directors carried along, for `carry.py`, several scenes per instruction.
//
// The formulas stand in rod.py (`advance_frames`, `reference_twist`) and rotation.py (`transport`), as tensor operations.
#include <vector>

#include "lanes.h"

namespace {

template <typename T>
Vec<T> transport(const Vec<T>& x, const Vec<T>& start, const Vec<T>& end) {
  const Vec<T> axis = cross(start, end), once = cross(axis, x);
  const Lanes<T> whole = dot(start, end) + T(1);
  return x + once + cross(axis, once) * (T(1) / (whole < T(1e-6) ? Lanes<T>{} + T(1e-6) : whole));
}

// Zero vectors have length zero.
template <typename T>
Lanes<T> length(const Vec<T>& x) {
  const Lanes<T> squared = dot(x, x);
  return squared <= TINY<T> * TINY<T> ? Lanes<T>{} : root<T>(squared);
}

template <typename T>
void carry(const Field<T>* from, T* const* to, const int64_t* sizes, const int64_t* after, int threads) {
  struct Slot {
    Vec<T> director, tangent, pos;
    Lanes<T> mask;
  };
  struct Carried {
    Vec<T> director, tangent;
  };
  const int64_t v = sizes[0], scenes = sizes[1], blocks = (scenes + WIDTH<T> - 1) / WIDTH<T>;
#pragma omp parallel num_threads(threads) if (threads > 1 && blocks > 1)
  {
    std::vector<Slot> slot(v);
    std::vector<Carried> now(v);
#pragma omp for schedule(static)
    for (int64_t block = 0; block < blocks; ++block) {
      const int64_t b = block * WIDTH<T>, lanes = scenes - b;
      fetch(slot, from, b, scenes);
      for (int64_t i = 0; i < v; ++i) {
        Vec<T> edge = slot[after[i]].pos - slot[i].pos;
        const auto real = slot[i].mask > T(0);
        edge = {real ? edge.x : Lanes<T>{} + T(1), real ? edge.y : Lanes<T>{}, real ? edge.z : Lanes<T>{}};
        const Lanes<T> size = length(edge);
        const Vec<T> tangent = edge * (T(1) / (size < T(1e-12) ? Lanes<T>{} + T(1e-12) : size));
        Vec<T> director = transport(slot[i].director, slot[i].tangent, tangent);
        director -= tangent * dot(tangent, director);
        const Lanes<T> whole = length(director);
        now[i] = {director * (T(1) / (whole == T(0) ? Lanes<T>{} + T(1) : whole)), tangent};
      }
      for (int64_t i = 0; i < v; ++i) {
        const int64_t n = after[i];
        const Vec<T>& own = now[n].director;
        const Vec<T> carried = transport(now[i].director, now[i].tangent, now[n].tangent);
        store<T>(to[1] + n * scenes + b, dot(cross(carried, own), now[n].tangent), lanes);
        store<T>(to[2] + n * scenes + b, dot(carried, own), lanes);
        store<T>(to[0] + i * scenes + b, now[i].director.x, lanes);
        store<T>(to[0] + (v + i) * scenes + b, now[i].director.y, lanes);
        store<T>(to[0] + (2 * v + i) * scenes + b, now[i].director.z, lanes);
      }
    }
  }
}

}  // namespace

extern "C" {
void carry_float(const Field<float>* from, float* const* to, const int64_t* sizes, const int64_t* after, int threads) {
  carry(from, to, sizes, after, threads);
}
void carry_double(const Field<double>* from, double* const* to, const int64_t* sizes, const int64_t* after,
                  int threads) {
  carry(from, to, sizes, after, threads);
}
}
