// Banded LU without pivoting for many systems of one sparsity, one scene per SIMD lane.
//
// entries (m, batch): values that may occur in the matrix, batch innermost.
// places (count, 2): entry, and where it stands in rows of 2k+1 bands, row * (2k+1) + column - row + k.
// order (n): the place in the right-hand side of the i-th unknown of the elimination order.
#include <cstdint>
#include <cstdlib>
#include <cstring>

// K is k where it is known at compile time, else 0. k rows of zeros follow the matrix, so that all loops are of length k.
template <typename T, int W, int K>
static void solve_lanes(const T* entries, const int32_t* places, int count, const int32_t* order, const T* rhs, T* out,
                        int n, int half, int64_t batch, int64_t first, int lanes, T* work) {
  const int k = K ? K : half, width = 2 * k + 1;
  T* a = work;
  T* y = work + (size_t)(n + k) * width * W;
  std::memset(a, 0, sizeof(T) * (size_t)(n + k) * (width + 1) * W);
  for (int p = 0; p < count; ++p) {
    const T* source = entries + (size_t)places[2 * p] * batch + first;
    T* target = a + (size_t)places[2 * p + 1] * W;
    if (lanes == W) {
      for (int w = 0; w < W; ++w) target[w] = source[w];
    } else {
      for (int w = 0; w < W; ++w) target[w] = source[w < lanes ? w : 0];
    }
  }
  for (int i = 0; i < n; ++i) {
    const T* source = rhs + (size_t)order[i] * batch + first;
    for (int w = 0; w < W; ++w) y[(size_t)i * W + w] = source[w < lanes ? w : 0];
  }
  for (int i = 0; i < n; ++i) {
    T* pivot_row = a + ((size_t)i * width + k) * W;
    T inverse[W];
    for (int w = 0; w < W; ++w) inverse[w] = pivot_row[w] = T(1) / pivot_row[w];
    for (int l = 1; l <= k; ++l) {
      T* row = a + ((size_t)(i + l) * width + k - l) * W;
      T factor[W];
      for (int w = 0; w < W; ++w) factor[w] = row[w] * inverse[w];
      for (int u = 1; u <= k; ++u)
        for (int w = 0; w < W; ++w) row[(size_t)u * W + w] -= factor[w] * pivot_row[(size_t)u * W + w];
      T* yl = y + (size_t)(i + l) * W;
      const T* yi = y + (size_t)i * W;
      for (int w = 0; w < W; ++w) yl[w] -= factor[w] * yi[w];
    }
  }
  for (int i = n - 1; i >= 0; --i) {
    const T* pivot_row = a + ((size_t)i * width + k) * W;
    T* yi = y + (size_t)i * W;
    for (int u = 1; u <= k; ++u)
      for (int w = 0; w < W; ++w) yi[w] -= pivot_row[(size_t)u * W + w] * yi[(size_t)u * W + w];
    for (int w = 0; w < W; ++w) yi[w] *= pivot_row[w];
    T* target = out + (size_t)order[i] * batch + first;
    for (int w = 0; w < lanes; ++w) target[w] = yi[w];
  }
}

template <typename T, int W, int K>
static void solve_all(const T* entries, const int32_t* places, int count, const int32_t* order, const T* rhs, T* out,
                      int n, int k, int64_t batch, int threads) {
  const int64_t blocks = (batch + W - 1) / W;
#pragma omp parallel num_threads(threads) if (threads > 1 && blocks > 1)
  {
    void* memory = nullptr;
    if (posix_memalign(&memory, 64, sizeof(T) * (size_t)(n + k) * (2 * k + 2) * W)) std::abort();
#pragma omp for schedule(static)
    for (int64_t block = 0; block < blocks; ++block) {
      const int64_t first = block * W;
      const int lanes = batch - first < W ? (int)(batch - first) : W;
      solve_lanes<T, W, K>(entries, places, count, order, rhs, out, n, k, batch, first, lanes, (T*)memory);
    }
    std::free(memory);
  }
}

// Open ropes have k = 1 (lengths, twist) and k = 8 (implicit steps). One scene gains nothing from knowing k.
template <typename T, int W>
static void solve(const T* entries, const int32_t* places, int count, const int32_t* order, const T* rhs, T* out,
                  int n, int k, int64_t batch, int threads) {
  if (batch == 1) solve_all<T, 1, 0>(entries, places, count, order, rhs, out, n, k, batch, 1);
  else if (k == 1) solve_all<T, W, 1>(entries, places, count, order, rhs, out, n, k, batch, threads);
  else if (k == 8) solve_all<T, W, 8>(entries, places, count, order, rhs, out, n, k, batch, threads);
  else solve_all<T, W, 0>(entries, places, count, order, rhs, out, n, k, batch, threads);
}

extern "C" {
void solve_float(const float* entries, const int32_t* places, int count, const int32_t* order, const float* rhs,
                 float* out, int n, int k, int64_t batch, int threads) {
  solve<float, 16>(entries, places, count, order, rhs, out, n, k, batch, threads);
}
void solve_double(const double* entries, const int32_t* places, int count, const int32_t* order, const double* rhs,
                  double* out, int n, int k, int64_t batch, int threads) {
  solve<double, 8>(entries, places, count, order, rhs, out, n, k, batch, threads);
}
}
