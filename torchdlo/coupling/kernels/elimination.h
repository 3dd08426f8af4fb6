// Linear systems of bodies, for scenes side by side.
#pragma once
#include "lanes.h"

// A linear system of blocks of six unknowns, eliminated without pivoting.
template <typename T>
struct Blocks {
  typedef Lanes<T> L;
  int count, n;
  List<char> fill;
  List<L> a;
  explicit Blocks(int count) : count(count), n(6 * count), fill(count * count), a(n * n) {}

  L& at(int i, int j) { return a[i * n + j]; }
  void couple(int i, int j) { fill[i * count + j] = fill[j * count + i] = 1; }
  void plan() {
    for (int k = 0; k < count; ++k) couple(k, k);
    for (int k = 0; k < count; ++k)
      for (int i = k + 1; i < count; ++i)
        for (int j = k + 1; j < count; ++j)
          if (fill[i * count + k] && fill[k * count + j]) couple(i, j);
  }
  template <typename W>
  void each(int row, int from, W work) {  // columns of a row that may differ from zero
    for (int b = from / 6; b < count; ++b)
      if (fill[row / 6 * count + b])
        for (int j = 6 * b > from ? 6 * b : from; j < 6 * b + 6; ++j) work(j);
  }
  void eliminate() {
    for (int k = 0; k < n; ++k) {
      const L inverse = T(1) / at(k, k);
      each(k, k + 1, [&](int i) {
        const L share = at(i, k) * inverse;
        at(i, k) = share;
        each(k, k + 1, [&](int j) { at(i, j) -= share * at(k, j); });
      });
    }
  }
  void solve(List<L>& x) {
    for (int k = 0; k < n; ++k) each(k, k + 1, [&](int i) { x[i] -= at(i, k) * x[k]; });
    for (int k = n; k--;) {
      each(k, k + 1, [&](int j) { x[k] -= at(k, j) * x[j]; });
      x[k] /= at(k, k);
    }
  }
  void solve_transposed(List<L>& x) {
    for (int k = 0; k < n; ++k) {
      x[k] /= at(k, k);
      each(k, k + 1, [&](int j) { x[j] -= at(k, j) * x[k]; });
    }
    for (int k = n; k--;) each(k, k + 1, [&](int i) { x[k] -= at(i, k) * x[i]; });
  }
};
