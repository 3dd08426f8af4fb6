// Closest points of straight segments side by side, and their derivative; see segments.py.
#pragma once
#include "tape.h"
#ifndef SIMT
#include <limits>
#endif

// Where the closest points lie, before they are put onto the segments, and what that is made of.
template <typename T>
struct Closest {
  typedef Num<T, 0> P;
  typedef Three<T, 0> V;
  V u, v, w;
  P uv, along, across, first, second, whole, determinant, guess, t, s;

  static P within(const P& a) { return larger(smaller(a, P(T(1))), P(T(0))); }
  explicit Closest(const V* p) : u(p[1] - p[0]), v(p[3] - p[2]), w(p[0] - p[2]) {
    const P uu = dot(u, u), vv = dot(v, v);
    const P pull = P(T(0.5 * PULL)) * (uu + vv) + P(TINY<T> * TINY<T>), half = P(T(0.5)) * pull;
    uv = dot(u, v), along = uu + pull, across = vv + pull, first = half - dot(u, w), second = half + dot(v, w);
    whole = along * across - uv * uv, determinant = larger(whole, P(std::numeric_limits<T>::min()));
    guess = (first * across + uv * second) / determinant;
    t = (second + uv * within(guess)) / across;
    s = (first + uv * within(t)) / along;
  }
};

template <typename T>
static inline void closest(const Three<T, 0>* p, Num<T, 0>& s, Num<T, 0>& t) {
  const Closest<T> c(p);
  s = c.within(c.s), t = c.within(c.t);
}
// Adds to `to` the derivative by the ends, from those by the shares.
template <typename T>
static inline void closest_back(const Three<T, 0>* p, const Num<T, 0>& by_s, const Num<T, 0>& by_t, Three<T, 0>* to) {
  typedef Num<T, 0> P;
  typedef Three<T, 0> V;
  const Closest<T> c(p);
  const P zero(T(0)), two(T(2));
  const auto passed = [&](const P& raw, const P& by) { return select((raw.x >= T(0)) & (raw.x <= T(1)), by, zero); };
  P g = passed(c.s, by_s) / c.along;
  P first = g, along = -(g * c.s), uv = g * c.within(c.t);
  g = passed(c.t, by_t + g * c.uv) / c.across;
  P second = g, across = -(g * c.t);
  uv = uv + g * c.within(c.guess);
  g = passed(c.guess, g * c.uv) / c.determinant;
  first = first + g * c.across, second = second + g * c.uv;
  uv = uv + g * c.second, across = across + g * c.first;
  g = select(c.whole.x >= std::numeric_limits<T>::min(), -(g * c.guess), zero);
  along = along + g * c.across, across = across + g * c.along, uv = uv - two * g * c.uv;
  const P pull = along + across + P(T(0.5)) * (first + second), more = P(T(0.5 * PULL)) * pull;
  const V u = c.u * (two * (along + more)) + c.v * uv - c.w * first;
  const V v = c.v * (two * (across + more)) + c.u * uv + c.w * second, w = c.v * second - c.u * first;
  to[0] += w - u, to[1] += u, to[2] -= v + w, to[3] += v;
}
