// Banded LU without pivoting for many systems of one sparsity, one scene per SIMD lane.
//
// entries (m, batch): values that may occur in the matrix, batch innermost.
// index (2k+1, n): which entry stands at A[i, i+d-k]; -1 is zero, -2 is one.
// order (n): the place in the right-hand side of the i-th unknown of the elimination order.
#include <cstdint>
#include <cstdlib>
#include <cstring>

template <typename T, int W>
static void solve_lanes(const T* entries, const int32_t* index, const int32_t* order, const T* rhs, T* out,
                        int n, int k, int64_t batch, int64_t first, int lanes, int transpose, T* work) {
  const int width = 2 * k + 1;
  T* a = work;
  T* y = work + (size_t)n * width * W;
  std::memset(a, 0, sizeof(T) * (size_t)n * width * W);
  for (int d = 0; d < width; ++d) {
    for (int i = 0; i < n; ++i) {
      const int32_t which = index[(size_t)d * n + i];
      if (which == -1) continue;
      const int row = transpose ? i + d - k : i;
      const int col = transpose ? 2 * k - d : d;
      T* target = a + ((size_t)row * width + col) * W;
      if (which == -2) {
        for (int w = 0; w < W; ++w) target[w] = T(1);
        continue;
      }
      const T* source = entries + (size_t)which * batch + first;
      if (lanes == W) {
        for (int w = 0; w < W; ++w) target[w] = source[w];
      } else {
        for (int w = 0; w < W; ++w) target[w] = source[w < lanes ? w : 0];
      }
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
    const int reach = n - 1 - i < k ? n - 1 - i : k;
    for (int l = 1; l <= reach; ++l) {
      T* row = a + ((size_t)(i + l) * width + k - l) * W;
      T factor[W];
      for (int w = 0; w < W; ++w) factor[w] = row[w] * inverse[w];
      for (int u = 1; u <= reach; ++u)
        for (int w = 0; w < W; ++w) row[(size_t)u * W + w] -= factor[w] * pivot_row[(size_t)u * W + w];
      T* yl = y + (size_t)(i + l) * W;
      const T* yi = y + (size_t)i * W;
      for (int w = 0; w < W; ++w) yl[w] -= factor[w] * yi[w];
    }
  }
  for (int i = n - 1; i >= 0; --i) {
    const T* pivot_row = a + ((size_t)i * width + k) * W;
    T* yi = y + (size_t)i * W;
    const int reach = n - 1 - i < k ? n - 1 - i : k;
    for (int u = 1; u <= reach; ++u)
      for (int w = 0; w < W; ++w) yi[w] -= pivot_row[(size_t)u * W + w] * yi[(size_t)u * W + w];
    for (int w = 0; w < W; ++w) yi[w] *= pivot_row[w];
    T* target = out + (size_t)order[i] * batch + first;
    for (int w = 0; w < lanes; ++w) target[w] = yi[w];
  }
}

template <typename T, int W>
static void solve_all(const T* entries, const int32_t* index, const int32_t* order, const T* rhs, T* out, int n,
                      int k, int64_t batch, int transpose, int threads) {
  const int64_t blocks = (batch + W - 1) / W;
#pragma omp parallel num_threads(threads) if (threads > 1 && blocks > 1)
  {
    void* memory = nullptr;
    if (posix_memalign(&memory, 64, sizeof(T) * (size_t)n * (2 * k + 2) * W)) std::abort();
#pragma omp for schedule(static)
    for (int64_t block = 0; block < blocks; ++block) {
      const int64_t first = block * W;
      const int lanes = batch - first < W ? (int)(batch - first) : W;
      solve_lanes<T, W>(entries, index, order, rhs, out, n, k, batch, first, lanes, transpose, (T*)memory);
    }
    std::free(memory);
  }
}

extern "C" {
void solve_float(const float* entries, const int32_t* index, const int32_t* order, const float* rhs, float* out,
                 int n, int k, int64_t batch, int transpose, int threads) {
  if (batch == 1) solve_all<float, 1>(entries, index, order, rhs, out, n, k, batch, transpose, 1);
  else solve_all<float, 16>(entries, index, order, rhs, out, n, k, batch, transpose, threads);
}
void solve_double(const double* entries, const int32_t* index, const int32_t* order, const double* rhs, double* out,
                  int n, int k, int64_t batch, int transpose, int threads) {
  if (batch == 1) solve_all<double, 1>(entries, index, order, rhs, out, n, k, batch, transpose, 1);
  else solve_all<double, 8>(entries, index, order, rhs, out, n, k, batch, transpose, threads);
}
}
