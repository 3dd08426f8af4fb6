// Solves many banded systems, for `banded.py`.
#include <cstdlib>

#include "banded.h"
#include "flush.h"
#include "lanes.h"

template <typename T, class L, int K>
static void solve_all(const T* entries, const int32_t* places, int count, const int32_t* order, const T* rhs, T* out,
                      int n, int k, int64_t batch, int threads) {
  constexpr int W = sizeof(L) / sizeof(T);
  const int64_t blocks = (batch + W - 1) / W;
#pragma omp parallel num_threads(threads) if (threads > 1 && blocks > 1)
  {
    const FlushTiny flush;
    void* memory = nullptr;
    if (posix_memalign(&memory, 64, sizeof(L) * (size_t)(n + k) * (2 * k + 2))) std::abort();
#pragma omp for schedule(static)
    for (int64_t block = 0; block < blocks; ++block) {
      const int64_t first = block * W;
      const int lanes = batch - first < W ? (int)(batch - first) : W;
      solve_lanes<T, L, K>(entries, places, count, order, rhs, out, n, k, batch, first, lanes, (L*)memory);
    }
    std::free(memory);
  }
}

// Open ropes have k = 1 (lengths, twist) and k = 8 (implicit steps). One scene gains nothing from knowing k.
template <typename T>
static void solve(const T* entries, const int32_t* places, int count, const int32_t* order, const T* rhs, T* out,
                  int n, int k, int64_t batch, int threads) {
  const auto all = batch == 1 ? solve_all<T, T, 0>
                   : k == 1   ? solve_all<T, Lanes<T>, 1>
                   : k == 8   ? solve_all<T, Lanes<T>, 8>
                              : solve_all<T, Lanes<T>, 0>;
  all(entries, places, count, order, rhs, out, n, k, batch, threads);
}

extern "C" {
void solve_float(const float* entries, const int32_t* places, int count, const int32_t* order, const float* rhs,
                 float* out, int n, int k, int64_t batch, int threads) {
  solve(entries, places, count, order, rhs, out, n, k, batch, threads);
}
void solve_double(const double* entries, const int32_t* places, int count, const int32_t* order, const double* rhs,
                  double* out, int n, int k, int64_t batch, int threads) {
  solve(entries, places, count, order, rhs, out, n, k, batch, threads);
}
}
