// Linear systems of Newton's method: banded, with a border of bodies, joints, and pairs of edges that touch.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "touching_scene.h"

namespace {

// Eight numbers, wherever they stand.
template <typename T>
struct Together {
  typedef T type __attribute__((vector_size(8 * sizeof(T)), aligned(sizeof(T)), may_alias));
};
template <typename T>
using Eight = typename Together<T>::type;
template <typename T>
Eight<T>& eight(T* first) {
  return *(Eight<T>*)first;
}

template <typename T>
void Scene<T>::transpose() {
  const int64_t width = 2 * k + 1;
  other.assign(band.size(), T(0));
  for (int64_t r = 0; r < n; ++r)
    for (int64_t c = std::max<int64_t>(0, r - k); c <= std::min(n - 1, r + k); ++c)
      other[c * width + r - c + k] = band[r * width + c - r + k];
  band.swap(other), border.swap(row);
  for (int64_t b = 0; b < s.bodies; ++b)
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < i; ++j) std::swap(corner[36 * b + 6 * i + j], corner[36 * b + 6 * j + i]);
}

// Solves for `step` and `turned` what `load_pos`, `load_length` and `load_body` are to be; or the transposed system.
template <typename T>
void Scene<T>::solve(bool transposed) {
  const int64_t extra = own + 3 * (int64_t)acting.size(), m = extra ? (1 + extra + 7) / 8 * 8 : 1;
  if (transposed) transpose();
  std::sort(acting.begin(), acting.end(), [](const Acting& a, const Acting& b) { return a.row < b.row; });
  side.assign((n + k) * m, T(0));  // by rank
  for (int64_t i = 0; i < v; ++i) {
    for (int c = 0; c < 3; ++c) side[rank[c * v + i] * m] = load_pos[3 * i + c];
    side[rank[3 * v + i] * m] = load_length[i];
  }
  for (int64_t u = 0; u < 3 * v; ++u)
    for (int64_t j = 0; j < own; ++j) side[rank[u] * m + 1 + j] = border[u * own + j];
  for (size_t a = 0; a < acting.size(); ++a) {
    const int64_t* at = corners + 4 * acting[a].pair;
    for (int q = 0; q < 4; ++q)
      for (int c = 0; c < 3; ++c)
        for (int f = 0; f < 3; ++f)
          side[rank[c * v + at[q]] * m + 1 + own + 3 * a + f] +=
              transposed ? feeling(acting[a], q, c, f) : given(acting[a], q, c, f);
  }
  switch (k) {
    case 8: eliminate<8>(m); break;
    case 16: eliminate<16>(m); break;
    default: eliminate<0>(m);
  }
  turned.assign(own, T(0));
  if (extra) border_out(transposed, extra, m);
  for (int64_t u = 0; u < n; ++u) step[u] = side[rank[u] * m];
}

// Solves the banded system for all columns of `side`; K is half its bandwidth, or 0 for any. Compilers do less well by
// loops over eight numbers than by vectors.
template <typename T>
template <int K>
void Scene<T>::eliminate(int64_t m) {
  const int64_t k = K ? K : this->k, width = 2 * k + 1;
  int64_t used = 1 + own;  // columns that are not 0 yet: pairs stand in the order of their first rows
  size_t next = 0;
  for (int64_t i = 0; i < n; ++i) {
    while (next < acting.size() && acting[next].row <= i) ++next, used += 3;
    T* pivot = &band[i * width + k];
    const T inverse = *pivot = 1 / *pivot;
    for (int64_t l = 0; l < k; ++l) factors[l] = band[(i + l + 1) * width + k - l - 1] * inverse;
    for (int64_t u = 0; u < k; u += 8) {
      const Eight<T> mine = eight(pivot + 1 + u);
      for (int64_t l = 0; l < k; ++l) eight(&band[(i + l + 1) * width + k - l + u]) -= factors[l] * mine;
    }
    if (m == 1) {
      for (int64_t l = 0; l < k; l += 8) eight(&side[i + 1 + l]) -= side[i] * eight(&factors[l]);
      continue;
    }
    for (int64_t j = 0; j < used; j += 8) {
      const Eight<T> mine = eight(&side[i * m + j]);
      for (int64_t l = 0; l < k; ++l) eight(&side[(i + l + 1) * m + j]) -= factors[l] * mine;
    }
  }
  for (int64_t i = n - 1; i >= 0; --i) {
    T* pivot = &band[i * width + k];
    if (m == 1) {
      Eight<T> sum = {};
      for (int64_t u = 1; u <= k; u += 8) sum += eight(pivot + u) * eight(&side[i + u]);
      for (int c = 0; c < 8; ++c) side[i] -= sum[c];
      side[i] *= *pivot;
      continue;
    }
    for (int64_t j = 0; j < m; j += 8) {
      Eight<T> mine = eight(&side[i * m + j]);
      for (int64_t u = 1; u <= k; ++u) mine -= pivot[u] * eight(&side[(i + u) * m + j]);
      eight(&side[i * m + j]) = mine * *pivot;
    }
  }
}

// Takes bodies, joints and pairs out by their Schur complement.
template <typename T>
void Scene<T>::border_out(bool transposed, int64_t extra, int64_t m) {
  std::vector<T> small(extra * (extra + 1), T(0));  // with its right-hand side behind
  const auto entry = [&](int64_t i, int64_t j) -> T& { return small[i * (extra + 1) + j]; };
  const auto minus = [&](int64_t i, T factor, int64_t unknown) {
    const T* x = &side[rank[unknown] * m];
    for (int64_t j = 0; j < extra; ++j) entry(i, j) -= factor * x[1 + j];
    entry(i, extra) -= factor * x[0];
  };
  for (int64_t b = 0; b < s.bodies; ++b)
    for (int i = 0; i < 6; ++i) {
      for (int j = 0; j < 6; ++j) {
        const T held = scale * inertia[36 * b + (transposed ? 6 * j + i : 6 * i + j)];
        entry(6 * b + i, 6 * b + j) = held + corner[36 * b + 6 * i + j];
      }
      entry(6 * b + i, extra) = load_body[6 * b + i];
    }
  for (int64_t a = 0; a < s.tied.count; ++a)
    for (int c = 0; c < 3; ++c) {
      const int64_t i = 6 * s.bodies + 3 * a + c, b = s.tied.body[a];
      entry(i, extra) = load_body[i];
      for (int j = 0; j < 6 && b >= 0; ++j) {
        entry(6 * b + j, i) = levers[18 * a + 3 * j + c];
        entry(i, 6 * b + j) = -reach[18 * a + 6 * c + j];
      }
    }
  for (int64_t u = 0; u < 3 * v; ++u)
    for (int64_t i = 0; i < own; ++i)
      if (row[u * own + i] != T(0)) minus(i, row[u * own + i], u);
  for (size_t a = 0; a < acting.size(); ++a) {
    const int64_t* at = corners + 4 * acting[a].pair;
    for (int f = 0; f < 3; ++f) {
      const int64_t i = own + 3 * a + f;
      entry(i, i) += 1;
      for (int q = 0; q < 4; ++q)
        for (int c = 0; c < 3; ++c)
          minus(i, -(transposed ? given(acting[a], q, c, f) : feeling(acting[a], q, c, f)), c * v + at[q]);
    }
  }
  for (int64_t i = 0; i < extra; ++i) {
    int64_t best = i;
    for (int64_t l = i + 1; l < extra; ++l)
      if (std::abs(entry(l, i)) > std::abs(entry(best, i))) best = l;
    if (best != i)
      for (int64_t j = i; j <= extra; ++j) std::swap(entry(i, j), entry(best, j));
    const T inverse = 1 / entry(i, i);
    for (int64_t l = i + 1; l < extra; ++l) {
      const T factor = entry(l, i) * inverse;
      if (factor == T(0)) continue;
      for (int64_t j = i; j <= extra; ++j) entry(l, j) -= factor * entry(i, j);
    }
  }
  std::vector<T> found(extra);
  for (int64_t i = extra - 1; i >= 0; --i) {
    T sum = entry(i, extra);
    for (int64_t j = i + 1; j < extra; ++j) sum -= entry(i, j) * found[j];
    found[i] = sum / entry(i, i);
  }
  std::copy(found.begin(), found.begin() + own, turned.begin());
  for (int64_t r = 0; r < n; ++r) {
    T* x = &side[r * m];
    for (int64_t j = 0; j < extra; ++j) x[0] -= x[1 + j] * found[j];
  }
}

}  // namespace
