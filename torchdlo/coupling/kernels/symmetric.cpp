// Isotropic functions of symmetric 3x3 tensors, plastic matter, and the derivatives of both, several tensors per
// instruction.
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

// Hencky elasticity with von Mises yield: formulas as in constitutive_models.py, all in the basis of the strain. Scenes
// one after the other: strain (B, 6, count), affine (B, 9, count), history (B, count), and Lame's constants and the yield
// stress (B, 3, count), or (B, 3, 1) if they are the same for all particles of a scene.
struct Sizes {
  int64_t scenes, count, each;  // each: whether numbers differ from particle to particle
  double dt;
};

template <typename T>
struct Plastic {
  int lanes;
  T before[6][W], a[9][W], g[9][W], strain[6][W];  // strain before and after the deformation I + a
  T first[W], mu[W], yield[W];
  Basis<T> b;
  T l[3][W], h[3][W], dev[3][W], size[W], most[W], excess[W], share[W], k[3][W], e[3][W];
  T flows[W];  // 1 or 0
  bool some;   // whether any flows

  static T root_of_two_thirds() { return T(0.81649658092772603); }
  template <class S>
  static void load(S (*to)[W], const T* from, int rows, int64_t count, int lanes) {
    for (int i = 0; i < rows; ++i) {
      for (int w = 0; w < W; ++w) to[i][w] = 0;
      for (int w = 0; w < lanes; ++w) to[i][w] = from[i * count + w];
    }
  }
  // Numbers of particles from the p-th of a scene on.
  Plastic(const T* strain_before, const T* affine, const T* numbers, const Sizes& n, int64_t p) {
    lanes = n.count - p < W ? int(n.count - p) : W;
    load(before, strain_before + p, 6, n.count, lanes), load(a, affine + p, 9, n.count, lanes);
    for (int w = 0; w < W; ++w) {
      const int64_t step = n.each ? n.count : 1, at = n.each ? p + (w < lanes ? w : 0) : 0;
      first[w] = numbers[at], mu[w] = numbers[step + at], yield[w] = numbers[2 * step + at];
    }
    for (int i = 0; i < 9; ++i)
      for (int w = 0; w < W; ++w) a[i][w] *= T(n.dt);
    for (int w = 0; w < W; ++w) {
      const T s[9] = {before[0][w], before[3][w], before[4][w], before[3][w], before[1][w],
                      before[5][w], before[4][w], before[5][w], before[2][w]};
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
          g[3 * i + j][w] = a[3 * i + j][w] + (a[3 * i][w] * s[j] + a[3 * i + 1][w] * s[3 + j] + a[3 * i + 2][w] * s[6 + j]);
      const auto turned = [&](int i, int j) {
        return g[3 * i + j][w] + g[3 * j + i][w] +
               (g[3 * i][w] * a[3 * j][w] + g[3 * i + 1][w] * a[3 * j + 1][w] + g[3 * i + 2][w] * a[3 * j + 2][w]);
      };
      strain[0][w] = before[0][w] + turned(0, 0), strain[1][w] = before[1][w] + turned(1, 1);
      strain[2][w] = before[2][w] + turned(2, 2), strain[3][w] = before[3][w] + turned(0, 1);
      strain[4][w] = before[4][w] + turned(0, 2), strain[5][w] = before[5][w] + turned(1, 2);
    }
    b.find(strain[0], W, W);
    for (int i = 0; i < 3; ++i)
      for (int w = 0; w < W; ++w) {
        l[i][w] = b.value[i][w] < T(CRUSHED) ? T(CRUSHED) : b.value[i][w];
        h[i][w] = function<T, HENCKY>(l[i][w]);
      }
    for (int w = 0; w < W; ++w) {
      const T mean = (h[0][w] + h[1][w] + h[2][w]) / 3;
      for (int i = 0; i < 3; ++i) dev[i][w] = h[i][w] - mean;
      const T square = dev[0][w] * dev[0][w] + dev[1][w] * dev[1][w] + dev[2][w] * dev[2][w];
      size[w] = std::sqrt(square), most[w] = root_of_two_thirds() * yield[w] / (2 * mu[w]);
      flows[w] = size[w] > most[w] ? T(1) : T(0);
      excess[w] = size[w] > most[w] ? size[w] - most[w] : T(0);
      share[w] = excess[w] / (size[w] > most[w] ? size[w] : T(1));
      for (int i = 0; i < 3; ++i) k[i][w] = h[i][w] - share[w] * dev[i][w];
    }
    T sum = 0;
    for (int w = 0; w < W; ++w) sum += flows[w];
    some = sum > 0;
    for (int i = 0; i < 3; ++i)
      for (int w = 0; w < W; ++w) e[i][w] = 0;
    for (int i = 0; some && i < 3; ++i)
      for (int w = 0; w < W; ++w) e[i][w] = function<T, FROM_HENCKY>(k[i][w]);
  }

  void answer(const T* history, T* stress, T* after, T* remembered, int64_t count) const {
    T x[6][W], y[6][W];
    for (int w = 0; w < W; ++w) {
      const T pressed = first[w] * (k[0][w] + k[1][w] + k[2][w]);
      for (int i = 0; i < 3; ++i) x[i][w] = 2 * mu[w] * k[i][w] + pressed, y[i][w] = e[i][w];
      for (int i = 3; i < 6; ++i) x[i][w] = y[i][w] = 0;
    }
    b.rotate(x, true);
    if (some) b.rotate(y, true);
    for (int i = 0; i < 6; ++i)
      for (int w = 0; w < W; ++w) y[i][w] = flows[w] > 0 ? y[i][w] : strain[i][w];
    for (int i = 0; i < 6; ++i)
      for (int w = 0; w < lanes; ++w) stress[i * count + w] = x[i][w], after[i * count + w] = y[i][w];
    for (int w = 0; w < lanes; ++w) remembered[w] = history[w] + root_of_two_thirds() * excess[w];
  }

  // From derivatives by what `answer` returns to those by strain, affine and numbers.
  void back(const T* stress_by, const T* after_by, const T* history_by, T* dbefore, T* daffine, T (*dnumbers)[W],
            const Sizes& n) const {
    const int64_t count = n.count;
    T x[6][W], y[6][W], d[6][W], past[W];
    // A component off the diagonal stands for two: half of it goes in, twice as much comes out.
    for (int i = 0; i < 6; ++i)
      for (int w = 0; w < W; ++w) {
        const T half = i < 3 ? T(1) : T(0.5);
        d[i][w] = w < lanes ? after_by[i * count + w] * half : T(0);
        x[i][w] = w < lanes ? stress_by[i * count + w] * half : T(0);
      }
    for (int i = 0; i < 6; ++i)
      for (int w = 0; w < W; ++w) y[i][w] = flows[w] > 0 ? d[i][w] : T(0), d[i][w] = flows[w] > 0 ? T(0) : d[i][w];
    for (int w = 0; w < W; ++w) past[w] = w < lanes ? history_by[w] : T(0);
    b.rotate(x, false);
    if (some) b.rotate(y, false);
    T z[6][W];
    for (int w = 0; w < W; ++w) {
      const T whole = x[0][w] + x[1][w] + x[2][w], sum = k[0][w] + k[1][w] + k[2][w], two = 2 * mu[w];
      const T dk0 = two * x[0][w] + first[w] * whole + 2 * (1 + e[0][w]) * y[0][w];
      const T dk1 = two * x[1][w] + first[w] * whole + 2 * (1 + e[1][w]) * y[1][w];
      const T dk2 = two * x[2][w] + first[w] * whole + 2 * (1 + e[2][w]) * y[2][w];
      const T dshare = -(dk0 * dev[0][w] + dk1 * dev[1][w] + dk2 * dev[2][w]);
      const T some_size = flows[w] > 0 ? size[w] : T(1), inverse = flows[w] / some_size;
      const T dexcess = flows[w] * (dshare * inverse + root_of_two_thirds() * past[w]);
      const T dsize = (dexcess - dshare * share[w] * inverse) * inverse;
      const T ddev0 = dsize * dev[0][w] - share[w] * dk0, ddev1 = dsize * dev[1][w] - share[w] * dk1;
      const T ddev2 = dsize * dev[2][w] - share[w] * dk2, mean = (ddev0 + ddev1 + ddev2) / 3;
      z[0][w] = (dk0 + ddev0 - mean) * T(0.5) / (1 + l[0][w]);
      z[1][w] = (dk1 + ddev1 - mean) * T(0.5) / (1 + l[1][w]);
      z[2][w] = (dk2 + ddev2 - mean) * T(0.5) / (1 + l[2][w]);
      dnumbers[0][w] = sum * whole;
      dnumbers[1][w] = 2 * (k[0][w] * x[0][w] + k[1][w] * x[1][w] + k[2][w] * x[2][w]) + dexcess * most[w] / mu[w];
      dnumbers[2][w] = -dexcess * root_of_two_thirds() / two;
    }
    static const int row[3] = {0, 0, 1}, column[3] = {1, 2, 2};
    for (int i = 0; i < 3; ++i)
      for (int w = 0; w < W; ++w) {
        const int p = row[i], q = column[i];
        z[3 + i][w] = (1 - share[w]) * slope<T, HENCKY>(l[p][w], l[q][w], h[p][w], h[q][w]);
        x[3 + i][w] *= 2 * mu[w];
      }
    for (int i = 0; some && i < 3; ++i)
      for (int w = 0; w < W; ++w) {
        const int p = row[i], q = column[i];
        x[3 + i][w] += slope<T, FROM_HENCKY>(k[p][w], k[q][w], e[p][w], e[q][w]) * y[3 + i][w];
      }
    for (int i = 3; i < 6; ++i)
      for (int w = 0; w < W; ++w) z[i][w] *= x[i][w];
    b.rotate(z, true);
    T ds[6][W], da[9][W];
    for (int w = 0; w < W; ++w) {
      T m[6];
      for (int i = 0; i < 6; ++i) m[i] = d[i][w] + z[i][w];
      const T by[9] = {m[0], m[3], m[4], m[3], m[1], m[5], m[4], m[5], m[2]};
      const T s[9] = {before[0][w], before[3][w], before[4][w], before[3][w], before[1][w],
                      before[5][w], before[4][w], before[5][w], before[2][w]};
      T dg[9], to[9];
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
          dg[3 * i + j] = 2 * by[3 * i + j] +
                          (by[3 * i] * a[j][w] + by[3 * i + 1] * a[3 + j][w] + by[3 * i + 2] * a[6 + j][w]);
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
          const T through = by[3 * i] * g[j][w] + by[3 * i + 1] * g[3 + j][w] + by[3 * i + 2] * g[6 + j][w];
          const T held = dg[3 * i] * s[j] + dg[3 * i + 1] * s[3 + j] + dg[3 * i + 2] * s[6 + j];
          da[3 * i + j][w] = T(n.dt) * (dg[3 * i + j] + held + through);
          to[3 * i + j] = by[3 * i + j] + (a[i][w] * dg[j] + a[3 + i][w] * dg[3 + j] + a[6 + i][w] * dg[6 + j]);
        }
      ds[0][w] = to[0], ds[1][w] = to[4], ds[2][w] = to[8];
      ds[3][w] = to[1] + to[3], ds[4][w] = to[2] + to[6], ds[5][w] = to[5] + to[7];
    }
    for (int i = 0; i < 6; ++i)
      for (int w = 0; w < lanes; ++w) dbefore[i * count + w] = ds[i][w];
    for (int i = 0; i < 9; ++i)
      for (int w = 0; w < lanes; ++w) daffine[i * count + w] = da[i][w];
  }
};

template <typename T>
static void plastic(const T* strain, const T* affine, const T* history, const T* numbers, T* stress, T* after,
                    T* remembered, const Sizes& n, int threads) {
  const int64_t many = 3 * (n.each ? n.count : 1);
#pragma omp parallel for num_threads(threads)
  for (int64_t b = 0; b < n.scenes; ++b) {
    const FlushTiny flush;
    for (int64_t p = 0; p < n.count; p += W) {
      const int64_t six = 6 * b * n.count + p, one = b * n.count + p;
      const Plastic<T> matter(strain + 6 * b * n.count, affine + 9 * b * n.count, numbers + many * b, n, p);
      matter.answer(history + one, stress + six, after + six, remembered + one, n.count);
    }
  }
}

template <typename T>
static void plastic_back(const T* strain, const T* affine, const T* numbers, const T* stress_by, const T* after_by,
                         const T* history_by, T* dstrain, T* daffine, T* dnumbers, const Sizes& n, int threads) {
  const int64_t step = n.each ? n.count : 1;
#pragma omp parallel for num_threads(threads)
  for (int64_t b = 0; b < n.scenes; ++b) {
    const FlushTiny flush;
    T *to = dnumbers + 3 * step * b, by[3][W];
    std::fill(to, to + 3 * step, T(0));
    for (int64_t p = 0; p < n.count; p += W) {
      const int64_t six = 6 * b * n.count + p, nine = 9 * b * n.count + p, one = b * n.count + p;
      const Plastic<T> matter(strain + 6 * b * n.count, affine + 9 * b * n.count, numbers + 3 * step * b, n, p);
      matter.back(stress_by + six, after_by + six, history_by + one, dstrain + six, daffine + nine, by, n);
      for (int i = 0; i < 3; ++i)
        for (int w = 0; w < matter.lanes; ++w) to[i * step + (n.each ? p + w : 0)] += by[i][w];
    }
  }
}

#define PLASTIC(T)                                                                                                    \
  extern "C" void symmetric_##T##_plastic(const T* strain, const T* affine, const T* history, const T* numbers,       \
                                          T* stress, T* after, T* remembered, const Sizes* n, int threads) {          \
    plastic<T>(strain, affine, history, numbers, stress, after, remembered, *n, threads);                             \
  }                                                                                                                   \
  extern "C" void symmetric_##T##_plastic_back(const T* strain, const T* affine, const T* numbers, const T* stress_by, \
                                               const T* after_by, const T* history_by, T* dstrain, T* daffine,        \
                                               T* dnumbers, const Sizes* n, int threads) {                            \
    plastic_back<T>(strain, affine, numbers, stress_by, after_by, history_by, dstrain, daffine, dnumbers, *n, threads); \
  }
PLASTIC(float)
PLASTIC(double)

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
