// Eigenvalues and eigenvectors of symmetric 3x3 tensors by cyclic Jacobi rotations, several tensors per instruction.
//
// tensors (6, count): xx, yy, zz, xy, xz, yz. values (3, count). vectors (9, count): row by row, one per column.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

static const int W = 16;  // tensors side by side

// Turns the plane of axes P and Q so that their coupling vanishes; components are (P, P), (Q, Q), (P, Q), (P, R), (Q, R).
template <typename T>
static inline void turn(T* __restrict pp, T* __restrict qq, T* __restrict pq, T* __restrict pr, T* __restrict qr,
                        T* __restrict u, int P, int Q) {
  for (int w = 0; w < W; ++w) {
    const T gap = qq[w] - pp[w], off = 2 * pq[w], r = pr[w];
    const T size = std::abs(gap) + std::sqrt(gap * gap + off * off) + std::numeric_limits<T>::min();
    // The clamp acts where squares underflow only.
    const T t = std::copysign(T(1), gap) * std::min(std::max(off / size, T(-1)), T(1));
    const T c = 1 / std::sqrt(1 + t * t), s = t * c;
    pp[w] -= t * pq[w];
    qq[w] += t * pq[w];
    pq[w] = 0;
    pr[w] = c * r - s * qr[w];
    qr[w] = s * r + c * qr[w];
    for (int i = 0; i < 9; i += 3) {
      const T a = u[(i + P) * W + w], b = u[(i + Q) * W + w];
      u[(i + P) * W + w] = c * a - s * b;
      u[(i + Q) * W + w] = s * a + c * b;
    }
  }
}

template <typename T>
static void all(const T* tensors, T* values, T* vectors, int64_t count, int sweeps) {
  for (int64_t first = 0; first < count; first += W) {
    const int lanes = count - first < W ? int(count - first) : W;
    T m[6][W], u[9 * W];
    for (int i = 0; i < 6; ++i)
      for (int w = 0; w < W; ++w) m[i][w] = w < lanes ? tensors[i * count + first + w] : T(0);
    for (int i = 0; i < 9; ++i)
      for (int w = 0; w < W; ++w) u[i * W + w] = i % 4 == 0;
    for (int k = 0; k < sweeps; ++k) {
      turn(m[0], m[1], m[3], m[4], m[5], u, 0, 1);
      turn(m[0], m[2], m[4], m[3], m[5], u, 0, 2);
      turn(m[1], m[2], m[5], m[3], m[4], u, 1, 2);
    }
    for (int i = 0; i < 3; ++i)
      for (int w = 0; w < lanes; ++w) values[i * count + first + w] = m[i][w];
    for (int i = 0; i < 9; ++i)
      for (int w = 0; w < lanes; ++w) vectors[i * count + first + w] = u[i * W + w];
  }
}

extern "C" void eigen_float(const float* tensors, float* values, float* vectors, int64_t count) {
  all<float>(tensors, values, vectors, count, 4);
}

extern "C" void eigen_double(const double* tensors, double* values, double* vectors, int64_t count) {
  all<double>(tensors, values, vectors, count, 5);
}
