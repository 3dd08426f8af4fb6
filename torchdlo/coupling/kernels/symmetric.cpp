// Isotropic functions of symmetric 3x3 tensors and their derivatives, several tensors per instruction.
//
// tensors (6, count): xx, yy, zz, xy, xz, yz. Eigenvectors by cyclic Jacobi rotations; formulas as in symmetric.py.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "flush.h"

static const int W = 16;  // tensors side by side

template <typename T>
struct Basis {
  T value[6][W], u[9 * W];  // tensor in its eigenbasis, eigenvectors row by row, one per column

  // Turns the plane of axes P and Q so that their coupling vanishes; components are (P, P), (Q, Q), (P, Q), (P, R), (Q, R).
  void turn(T* __restrict pp, T* __restrict qq, T* __restrict pq, T* __restrict pr, T* __restrict qr, int P, int Q) {
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
  void find(const T* tensors, int64_t count, int lanes) {
    const int sweeps = sizeof(T) == 8 ? 5 : 4;
    auto& m = value;
    for (int i = 0; i < 6; ++i)
      for (int w = 0; w < W; ++w) m[i][w] = w < lanes ? tensors[i * count + w] : T(0);
    for (int i = 0; i < 9; ++i)
      for (int w = 0; w < W; ++w) u[i * W + w] = i % 4 == 0;
    for (int k = 0; k < sweeps; ++k) {
      turn(m[0], m[1], m[3], m[4], m[5], 0, 1);
      turn(m[0], m[2], m[4], m[3], m[5], 0, 2);
      turn(m[1], m[2], m[5], m[3], m[4], 1, 2);
    }
  }
  // U X U^T, or U^T X U.
  void rotate(T (*x)[W], bool back) const {
    for (int w = 0; w < W; ++w) {
      T v[9], left[9];
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) v[3 * i + j] = back ? u[(3 * i + j) * W + w] : u[(3 * j + i) * W + w];
      const T s[9] = {x[0][w], x[3][w], x[4][w], x[3][w], x[1][w], x[5][w], x[4][w], x[5][w], x[2][w]};
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) left[3 * i + j] = v[3 * i] * s[j] + v[3 * i + 1] * s[3 + j] + v[3 * i + 2] * s[6 + j];
      const auto at = [&](int i, int j) {
        return left[3 * i] * v[3 * j] + left[3 * i + 1] * v[3 * j + 1] + left[3 * i + 2] * v[3 * j + 2];
      };
      x[0][w] = at(0, 0), x[1][w] = at(1, 1), x[2][w] = at(2, 2);
      x[3][w] = at(0, 1), x[4][w] = at(0, 2), x[5][w] = at(1, 2);
    }
  }
};

// Numbers side by side without branches, so that the compiler works on many at once; 2^k from the exponent's bits.
template <typename T>
struct Bits;
template <>
struct Bits<float> {
  typedef int32_t I;
  static constexpr int FRACTION = 23, BIAS = 127;
};
template <>
struct Bits<double> {
  typedef int64_t I;
  static constexpr int FRACTION = 52, BIAS = 1023;
};
template <typename T>
union Word {
  T x;
  typename Bits<T>::I i;
};
template <typename T>
static inline T power(T k) {
  Word<T> w;
  w.i = (typename Bits<T>::I(k) + Bits<T>::BIAS) << Bits<T>::FRACTION;
  return w.x;
}

// log(1 + x), x > -1: 1 + x = 2^k (1 + f) with 1 + f within [sqrt(1/2), sqrt(2)], log(1 + f) = 2 atanh(f / (2 + f)).
template <typename T>
static inline T logarithm(T x) {
  Word<T> w;
  w.x = (1 + x) * T(1.41421356237309515);
  const T k = T((w.i >> Bits<T>::FRACTION) - Bits<T>::BIAS);
  // 1 + x is exact to half a unit: without a power of two, take x as it is.
  const T f = k == 0 ? x : (1 + x) * power<T>(-k) - 1;
  const T s = f / (2 + f), z = s * s;
  T sum = T(1) / 23;
  for (int n = 21; n > 1; n -= 2) sum = sum * z + T(1) / n;
  return k * T(0.693147180559945309417) + 2 * s * (1 + z * sum);
}

// exp(x) - 1 with x = k log(2) + r; exponents beyond the range of T count as the last ones.
template <typename T>
static inline T exponential(T x) {
  const T most = T(Bits<T>::BIAS - 1) * T(0.69);
  const T y = x > most ? most : (x < -most ? -most : x);
  const T k = std::nearbyint(y * T(1.4426950408889634074));
  const T high = sizeof(T) == 8 ? T(0.693147180369123816490) : T(0.693359375);
  const T low = sizeof(T) == 8 ? T(1.90821492927058770002e-10) : T(-2.12194440e-4);
  const T r = (y - k * high) - k * low;
  T sum = 1;
  for (int n = 14; n > 1; --n) sum = 1 + sum * r * (T(1) / n);
  const T two = power<T>(k);
  return two * (r * sum) + (two - 1);
}

enum Which { STRETCH, HENCKY, FROM_HENCKY };
static const double CRUSHED = -1 + 1e-6;  // see symmetric.py

template <typename T, int WHICH>
static inline T function(T l) {
  if (WHICH == STRETCH) return l / (1 + std::sqrt(1 + l));
  if (WHICH == HENCKY) return T(0.5) * logarithm(l);
  return exponential(2 * l);
}

// (f(a) - f(b)) / (a - b), by its series where a and b are close; `fa` and `fb` are f(a) and f(b).
template <typename T, int WHICH>
static inline T slope(T a, T b, T fa, T fb) {
  if (WHICH == STRETCH) return 1 / (std::sqrt(1 + a) + std::sqrt(1 + b));
  const T gap = a - b;
  if (WHICH == HENCKY) {
    const T sum = 2 + a + b, z = gap / sum, z2 = z * z;
    T series = T(1) / 19;
    for (int n = 17; n > 0; n -= 2) series = series * z2 + T(1) / n;
    return z2 < T(0.01) ? series / sum : (fa - fb) / gap;
  }
  const T d2 = gap * gap;
  T series = 1;
  for (int n = 14; n > 0; n -= 2) series = 1 + series * d2 * (T(1) / (n * (n + 1)));
  return d2 < T(0.1) ? 2 * std::sqrt((1 + fa) * (1 + fb)) * series : (fa - fb) / gap;
}

template <typename T, int WHICH>
static void act(const T* tensors, const T* by, T* out, int64_t count, int threads) {
#pragma omp parallel for num_threads(threads)
  for (int64_t first = 0; first < count; first += W) {
    const FlushTiny flush;
    const int lanes = count - first < W ? int(count - first) : W;
    Basis<T> b;
    b.find(tensors + first, count, lanes);
    T l[3][W], f[3][W], x[6][W];
    for (int i = 0; i < 3; ++i)
      for (int w = 0; w < W; ++w) {
        l[i][w] = WHICH != FROM_HENCKY && b.value[i][w] < T(CRUSHED) ? T(CRUSHED) : b.value[i][w];
        f[i][w] = function<T, WHICH>(l[i][w]);
      }
    if (!by) {
      for (int w = 0; w < W; ++w) x[0][w] = f[0][w], x[1][w] = f[1][w], x[2][w] = f[2][w];
      for (int w = 0; w < W; ++w) x[3][w] = x[4][w] = x[5][w] = 0;
      b.rotate(x, true);
    } else {
      // A component off the diagonal stands for two: half of it goes in, twice as much comes out.
      for (int i = 0; i < 6; ++i)
        for (int w = 0; w < W; ++w) x[i][w] = w < lanes ? by[i * count + first + w] * (i < 3 ? T(1) : T(0.5)) : T(0);
      b.rotate(x, false);
      static const int row[6] = {0, 1, 2, 0, 0, 1}, column[6] = {0, 1, 2, 1, 2, 2};
      for (int i = 0; i < 6; ++i)
        for (int w = 0; w < W; ++w) {
          const int p = row[i], q = column[i];
          x[i][w] *= slope<T, WHICH>(l[p][w], l[q][w], f[p][w], f[q][w]);
        }
      b.rotate(x, true);
      for (int i = 3; i < 6; ++i)
        for (int w = 0; w < W; ++w) x[i][w] *= 2;
    }
    for (int i = 0; i < 6; ++i)
      for (int w = 0; w < lanes; ++w) out[i * count + first + w] = x[i][w];
  }
}

// `by` is the derivative by the result, or nullptr for the result itself.
template <typename T>
static void choose(int which, const T* tensors, const T* by, T* out, int64_t count, int threads) {
  if (which == STRETCH) act<T, STRETCH>(tensors, by, out, count, threads);
  if (which == HENCKY) act<T, HENCKY>(tensors, by, out, count, threads);
  if (which == FROM_HENCKY) act<T, FROM_HENCKY>(tensors, by, out, count, threads);
}

extern "C" void symmetric_float_act(int which, const float* tensors, const float* by, float* out, int64_t count,
                                    int threads) {
  choose<float>(which, tensors, by, out, count, threads);
}

extern "C" void symmetric_double_act(int which, const double* tensors, const double* by, double* out, int64_t count,
                                     int threads) {
  choose<double>(which, tensors, by, out, count, threads);
}
