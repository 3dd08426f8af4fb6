// Banded LU without pivoting for many systems of one sparsity, one scene per SIMD lane.
//
// entries (m, batch): values that may occur in the matrix, batch innermost.
// places (count, 2): entry, and where it stands in rows of 2k+1 bands, row * (2k+1) + column - row + k.
// order (n): the place in the right-hand side of the i-th unknown of the elimination order.
// work: (n + k) (2k + 2) numbers of type L.
#pragma once
#include <cstdint>
#include <cstring>

// L holds one number per scene, of type T. K is k where it is known at compile time, else 0. k rows of zeros follow the
// matrix, so that all loops are of length k.
template <typename T, class L, int K>
static void solve_lanes(const T* entries, const int32_t* places, int count, const int32_t* order, const T* rhs, T* out,
                        int n, int half, int64_t batch, int64_t first, int lanes, L* work) {
  constexpr int W = sizeof(L) / sizeof(T);
  const int k = K ? K : half, width = 2 * k + 1;
  L *const a = work, *const y = work + (size_t)(n + k) * width;
  std::memset((void*)a, 0, sizeof(L) * (size_t)(n + k) * (width + 1));
  const auto read = [&](const T* from) {
    L x;
    if (lanes == W) {
      std::memcpy(&x, from, sizeof(x));
    } else {
      for (int w = 0; w < W; ++w) ((T*)&x)[w] = from[w < lanes ? w : 0];
    }
    return x;
  };
  for (int p = 0; p < count; ++p) a[places[2 * p + 1]] = read(entries + (size_t)places[2 * p] * batch + first);
  for (int j = 0; j < n; ++j) y[j] = read(rhs + (size_t)order[j] * batch + first);
  const auto at = [&](int row, int column) -> L& { return a[(size_t)row * width + k + column - row]; };
  int i = 0;
  if constexpr (K > 1) {
    // Two pivots at a time: what is left is read and written half as often.
    for (; i + 1 < n; i += 2) {
      const L first = at(i, i) = T(1) / at(i, i), own = y[i];
      L left[K], below[K];  // in registers
      for (int u = 0; u < K; ++u) left[u] = at(i, i + 1 + u);
      const L start = at(i + 1, i) * first;
      for (int u = 1; u < K; ++u) below[u - 1] = at(i + 1, i + 1 + u) -= start * left[u];
      below[K - 1] = at(i + 1, i + 1 + K);
      const L second = at(i + 1, i + 1) = T(1) / (at(i + 1, i + 1) - start * left[0]), next = y[i + 1] -= start * own;
      for (int l = 2; l <= K; ++l) {
        L* row = &at(i + l, i);
        const L one = row[0] * first, two = (row[1] - one * left[0]) * second;
        for (int u = 1; u < K; ++u) row[u + 1] -= one * left[u] + two * below[u - 1];
        row[K + 1] -= two * below[K - 1];
        y[i + l] -= one * own + two * next;
      }
      L* row = &at(i + 1 + K, i + 1);
      const L two = row[0] * second;
      for (int u = 0; u < K; ++u) row[u + 1] -= two * below[u];
      y[i + 1 + K] -= two * next;
    }
  }
  for (; i < n; ++i) {
    L* pivot = &at(i, i);
    const L inverse = *pivot = T(1) / *pivot, own = y[i];
    for (int l = 1; l <= k; ++l) {
      L* row = &at(i + l, i);
      const L factor = *row * inverse;
      for (int u = 1; u <= k; ++u) row[u] -= factor * pivot[u];
      y[i + l] -= factor * own;
    }
  }
  for (i = n - 1; i >= 0; --i) {
    const L* pivot = a + (size_t)i * width + k;
    L x = y[i];
    for (int u = 1; u <= k; ++u) x -= pivot[u] * y[i + u];
    y[i] = x *= *pivot;
    std::memcpy(out + (size_t)order[i] * batch + first, &x, sizeof(T) * lanes);
  }
}
