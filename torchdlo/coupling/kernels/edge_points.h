// Points of edges that are nearest to bodies; the formulas of shape_sdf.py and segment_distance.py, for scenes side by side.
#pragma once
#include "tape.h"

enum Shape { PLANE, SPHERE, BOX, CAPSULE, CYLINDER, CONE, TORUS, RING, MESH };

// Distances of a mesh at the corners of the cells of its grid, z fastest; the same in all scenes.
template <typename T>
struct Grid {
  const T* values;
  const int64_t* cells;  // in x, y and z
};

// Length of a vector of M numbers, and its direction; that of zero vectors is an axis.
template <int M, typename T, int N>
static inline Num<T, N> unit(const Num<T, N>* v, int axis, Num<T, N>* direction) {
  Num<T, N> squared = v[0] * v[0];
  for (int k = 1; k < M; ++k) squared = squared + v[k] * v[k];
  const auto zero = squared.x <= TINY<T> * TINY<T>;
  const Num<T, N> length = root(select(zero, Num<T, N>(T(1)), squared));
  for (int k = 0; k < M; ++k) direction[k] = select(zero, Num<T, N>(T(k == axis)), v[k] / length);
  return select(zero, Num<T, N>(T(0)), length);
}

NUM sign(const Num<T, N>& a) { return select(a.x < T(0), Num<T, N>(T(-1)), Num<T, N>(T(1))); }

template <int M, typename T, int N>
static inline Num<T, N> faces(const Num<T, N>* beyond, Num<T, N>* normal) {
  const Num<T, N> zero(T(0)), one(T(1));
  Num<T, N> deepest = beyond[0], out[M], away[M], count = zero;
  for (int k = 1; k < M; ++k) deepest = larger(deepest, beyond[k]);
  for (int k = 0; k < M; ++k) out[k] = larger(beyond[k], zero);
  for (int k = 0; k < M; ++k) count = count + select(beyond[k].x == deepest.x, one, zero);
  const Num<T, N> outside = unit<M>(out, 0, away), share = one / root(count);
  for (int k = 0; k < M; ++k) {
    const Num<T, N> inside = select(beyond[k].x == deepest.x, share, zero);
    normal[k] = select(outside.x > T(0), away[k], inside);
  }
  return select(outside.x > T(0), outside, deepest);
}

NUM cone(const Num<T, N>* size, const Num<T, N>* p, Num<T, N>* n) {
  typedef Num<T, N> S;
  const S zero(T(0)), radius = size[0], height = size[1];
  S out[2], apex[2], rim[2];
  const S across = unit<2>(p, 0, out), slope = root(radius * radius + height * height);
  const S x = across - radius, z = p[2] + height * S(T(0.25));
  const S side = (x * height + z * radius) / slope, along = (z * height - x * radius) / slope, below = -z;
  const S from_apex[2] = {across, z - height}, from_rim[2] = {x, z};
  const S to_apex = unit<2>(from_apex, 1, apex), to_rim = unit<2>(from_rim, 0, rim);
  const auto outside = (side.x > T(0)) | (below.x > T(0));
  const auto by_side = (side.x > T(0)) & (along.x >= T(0));
  const auto at_apex = by_side & (along.x > slope.x);
  const auto at_rim = outside & ~by_side & (x.x > T(0));
  const auto face = (outside & by_side) | (~outside & (side.x > below.x));
  const S slanted[2] = {height / slope, radius / slope}, down[2] = {zero, S(T(-1))};
  S flat[2];
  for (int k = 0; k < 2; ++k)
    flat[k] = select(at_apex, apex[k], select(at_rim, rim[k], select(face, slanted[k], down[k])));
  n[0] = flat[0] * out[0], n[1] = flat[0] * out[1], n[2] = flat[1];
  return select(at_apex, to_apex, select(at_rim, to_rim, select(face, side, below)));
}

// The tube of a torus or a ring: `on` points from its centre to the nearest place of the circle.
NUM tube(const Num<T, N>* size, const Num<T, N>* p, const Num<T, N>* on, Num<T, N>* n) {
  const Num<T, N> away[3] = {p[0] - size[0] * on[0], p[1] - size[0] * on[1], p[2]};
  return unit<3>(away, 2, n) - size[1];
}

// Interpolates the grid trilinearly; beyond it, goes on from the surface nearest to its border.
NUM sampled(const Grid<T>& grid, const Num<T, N>* size, const Num<T, N>* p, Num<T, N>* n) {
  typedef Num<T, N> S;
  const S zero(T(0)), one(T(1));
  const int64_t nz = grid.cells[2] + 1, ny = grid.cells[1] + 1;
  int64_t first[WIDTH<T>] = {};
  S inside[3], f[3], g[3], at[2][2][2], low[2][2], slab[2], beyond[3];
  auto out = zero.x > T(0);
  for (int k = 0; k < 3; ++k) {
    inside[k] = larger(-size[k], smaller(size[k], p[k]));  // in this order what is not a number stays so
    const int64_t last = grid.cells[k] - 1;
    const S place = (inside[k] / size[k] + one) * S(T(0.5 * grid.cells[k]));
    Lanes<T> cell{};
    for (int i = 0; i < WIDTH<T>; ++i) {
      // A place that is not a number may be looked up anywhere: its share makes the answer not a number.
      const T x = place.x[i] > T(0) ? std::floor(place.x[i]) : T(0);
      const int64_t c = x < T(last) ? int64_t(x) : last;
      cell[i] = T(c);
      first[i] += c * (k == 0 ? ny * nz : k == 1 ? nz : 1);
    }
    f[k] = place - S(cell), g[k] = one - f[k];
    beyond[k] = p[k] - inside[k];
    out = out | (magnitude(beyond[k]).x > T(0));
  }
  for (int i = 0; i < 2; ++i)
    for (int j = 0; j < 2; ++j) {
      for (int k = 0; k < 2; ++k) {
        Lanes<T> corner;
        for (int l = 0; l < WIDTH<T>; ++l) corner[l] = grid.values[first[l] + (i * ny + j) * nz + k];
        at[i][j][k] = S(corner);
      }
      low[i][j] = at[i][j][0] * g[2] + at[i][j][1] * f[2];
    }
  for (int i = 0; i < 2; ++i) slab[i] = low[i][0] * g[1] + low[i][1] * f[1];
  const S distance = slab[0] * g[0] + slab[1] * f[0];
  S rise[3] = {slab[1] - slab[0], (low[0][1] - low[0][0]) * g[0] + (low[1][1] - low[1][0]) * f[0], zero}, away[3];
  for (int i = 0; i < 2; ++i) {
    const S step = (at[i][0][1] - at[i][0][0]) * g[1] + (at[i][1][1] - at[i][1][0]) * f[1];
    rise[2] = rise[2] + step * (i ? f[0] : g[0]);
  }
  for (int k = 0; k < 3; ++k) rise[k] = rise[k] * S(T(grid.cells[k])) / size[k];
  unit<3>(rise, 2, n);
  for (int k = 0; k < 3; ++k) beyond[k] = beyond[k] + distance * n[k];
  const S far = unit<3>(beyond, 2, away);
  for (int k = 0; k < 3; ++k) n[k] = select(out, away[k], n[k]);
  return select(out, far, distance);
}

template <typename T, int N>
static inline CALLED Num<T, N> probe(int shape, const Grid<T>& grid, const Num<T, N>* size, const Num<T, N>* p, Num<T, N>* n) {
  typedef Num<T, N> S;
  const S zero(T(0)), one(T(1));
  S out[2], on[2];
  switch (shape) {
    case MESH:
      return sampled(grid, size, p, n);
    case SPHERE:
      return unit<3>(p, 2, n) - size[0];
    case BOX: {
      const S beyond[3] = {magnitude(p[0]) - size[0], magnitude(p[1]) - size[1], magnitude(p[2]) - size[2]};
      const S distance = faces<3>(beyond, n);
      for (int k = 0; k < 3; ++k) n[k] = n[k] * sign(p[k]);
      return distance;
    }
    case CAPSULE: {
      const S away[3] = {p[0], p[1], p[2] - larger(smaller(p[2], size[1]), -size[1])};
      return unit<3>(away, 0, n) - size[0];
    }
    case CYLINDER: {
      S flat[2];
      const S across = unit<2>(p, 0, out), beyond[2] = {across - size[0], magnitude(p[2]) - size[1]};
      const S distance = faces<2>(beyond, flat);
      n[0] = flat[0] * out[0], n[1] = flat[0] * out[1], n[2] = flat[1] * sign(p[2]);
      return distance;
    }
    case CONE:
      return cone(size, p, n);
    case TORUS:
      unit<2>(p, 0, out);
      return tube(size, p, out, n);
    case RING: {  // size: radii of circle and tube, cosine and sine of half the angle
      unit<2>(p, 0, out);
      const auto beside = size[3].x * p[0].x - size[2].x * magnitude(p[1]).x > T(0);
      on[0] = select(beside, out[0], size[2]);
      on[1] = select(beside, out[1], size[3] * sign(p[1]));
      return tube(size, p, on, n);
    }
    default:
      n[0] = zero, n[1] = zero, n[2] = one;
      return p[2];
  }
}

// Radius of a ball about the origin that holds a shape; planes have none.
template <typename T>
static Lanes<T> bounding(int shape, const Lanes<T>* size) {
  switch (shape) {
    case SPHERE:
      return size[0];
    case BOX:
    case MESH:
      return root<T>(size[0] * size[0] + size[1] * size[1] + size[2] * size[2]);
    case CYLINDER:
      return root<T>(size[0] * size[0] + size[1] * size[1]);
    default:  // capsules, cones, and what is round
      return size[0] + size[1];
  }
}

template <typename T, int N>
struct Line {
  int shape;
  Grid<T> grid;
  Num<T, N> start[3], edge[3], size[4], length;

  Line(int shape, const Grid<T>& grid, const Vec<T>& from, const Vec<T>& along, const Lanes<T>* numbers)
      : shape(shape), grid(grid) {
    const Lanes<T> all[10] = {from.x,  from.y,     from.z,     along.x,    along.y,
                              along.z, numbers[0], numbers[1], numbers[2], numbers[3]};
    for (int k = 0; k < 10; ++k) (k < 3 ? start[k] : k < 6 ? edge[k - 3] : size[k - 6]) = Num<T, N>::variable(all[k], k);
    Num<T, N> direction[3];
    length = unit<3>(edge, 0, direction);
  }

  Line(int shape, const Grid<T>& grid, const Three<T, N>& from, const Three<T, N>& along, const Num<T, N>* numbers)
      : shape(shape), grid(grid) {
    for (int k = 0; k < 3; ++k) start[k] = from[k], edge[k] = along[k];
    for (int k = 0; k < 4; ++k) size[k] = numbers[k];
    Num<T, N> direction[3];
    length = unit<3>(edge, 0, direction);
  }

  Num<T, N> at(const Num<T, N>& share, Num<T, N>* normal) const {
    const Num<T, N> p[3] = {start[0] + share * edge[0], start[1] + share * edge[1], start[2] + share * edge[2]};
    return probe(shape, grid, size, p, normal);
  }

  Num<T, N> slope(const Num<T, N>& share, T middle) const {
    Num<T, N> n[3];
    at(share, n);
    return rise(share, n, middle);
  }
  // The same where the normal is known.
  Num<T, N> rise(const Num<T, N>& share, const Num<T, N>* n, T middle) const {
    const Num<T, N> pull(PULL), half(middle);
    return n[0] * edge[0] + n[1] * edge[1] + n[2] * edge[2] + pull * length * (share - half);
  }

  static constexpr T PULL = T(0.01);
};

template <typename T>
struct Found {
  Lanes<T> share, steep, left, right;
};

// Whether the distance from a shape is convex, so that slopes alone tell where it is least.
static inline bool convex(int shape) { return shape != TORUS && shape != RING && shape != MESH; }

// See `_search` in segment_distance.py.
template <typename T>
static Found<T> nearest(const Line<T, 0>& line, T low, T high) {
  typedef Lanes<T> L;
  typedef Num<T, 0> S;
  const int places = 8;
  const T middle = T(0.5) * (low + high), step = sizeof(T) == 8 ? T(1e-4) : T(2e-3);
  const L pull = Line<T, 0>::PULL * line.length.x, floor = pull > TINY<T> ? pull : L{} + TINY<T>;
  L left = L{} + low, right = L{} + high;
  if (!convex(line.shape)) {
    const T part = (high - low) / places;
    L best = left, least{}, rise{};
    S n[3];
    for (int k = 0; k <= places; ++k) {
      const T share = low + part * k;
      const L value = line.at(S(share), n).x + T(0.5) * pull * ((share - middle) * (share - middle));
      const auto better = k == 0 ? value == value : value < least;
      least = better ? value : least;
      best = better ? L{} + share : best;
      rise = better ? line.rise(S(share), n, middle).x : rise;
    }
    const L before = best - part, after = best + part;
    left = rise <= T(0) ? best : before > left ? before : left;
    right = rise <= T(0) ? (after < right ? after : right) : best;
  }
  for (int k = convex(line.shape) ? 5 : 4; k--;) {
    const L half = T(0.5) * (left + right);
    const auto falling = line.slope(S(half), middle).x <= T(0);
    left = falling ? half : left;
    right = falling ? right : half;
  }
  // The middle of a piece is nearest to what is flat: it must not be a bound, where the share would have no derivative.
  const L spare = T(0.25) * (right - left), below = left - spare, above = right + spare;
  left = below > low ? below : L{} + low, right = above < high ? above : L{} + high;
  Found<T> f{T(0.5) * (left + right), L{}, left, right};
  for (int k = 0;; ++k) {
    const L steep = (line.slope(S(f.share + step), middle).x - line.slope(S(f.share - step), middle).x) / (2 * step);
    f.steep = steep > floor ? steep : floor;
    if (k == 2) return f;
    const L next = f.share - line.slope(S(f.share), middle).x / f.steep;
    f.share = next < left ? left : next > right ? right : next;
  }
}

// Share, distance and normal: after the last step of Newton's method where there was a search, else at a share that is
// given; with derivatives if N is not 0. `at` is that share, or the middle of the piece that was searched.
template <typename T, int N>
static void end(const Line<T, N>& line, const Found<T>* found, T at, Num<T, N>* result) {
  typedef Num<T, N> S;
  result[0] = S(at);
  if (found) {
    const S raw = S(found->share) - line.slope(S(found->share), at) / S(found->steep);
    result[0] = larger(smaller(raw, S(found->right)), S(found->left));
  }
  result[1] = line.at(result[0], result + 2);
}
