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
  for (int i = 0; i < n; ++i) y[i] = read(rhs + (size_t)order[i] * batch + first);
  for (int i = 0; i < n; ++i) {
    L* pivot = a + (size_t)i * width + k;
    const L inverse = T(1) / *pivot, own = y[i];
    *pivot = inverse;
    L after[K ? K : 1];  // in registers
    for (int u = 0; u < K; ++u) after[u] = pivot[u + 1];
    for (int l = 1; l <= k; ++l) {
      L* row = a + (size_t)(i + l) * width + k - l;
      const L factor = *row * inverse;
      for (int u = 1; u <= k; ++u) row[u] -= factor * (K ? after[u - 1] : pivot[u]);
      y[i + l] -= factor * own;
    }
  }
  for (int i = n - 1; i >= 0; --i) {
    const L* pivot = a + (size_t)i * width + k;
    L x = y[i];
    for (int u = 1; u <= k; ++u) x -= pivot[u] * y[i + u];
    y[i] = x *= *pivot;
    std::memcpy(out + (size_t)order[i] * batch + first, &x, sizeof(T) * lanes);
  }
}
