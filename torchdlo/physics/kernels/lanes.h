// Numbers of several scenes side by side, with any number of derivatives carried along.
#pragma once
#ifdef SIMT
#include "simt.h"
#else
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <new>
#include <vector>

// As many numbers as a register holds: compilers take comparisons of longer vectors apart, number by number.
#if defined(__AVX512F__)
#define LANES_BYTES 64
#elif defined(__AVX__)
#define LANES_BYTES 32
#else
#define LANES_BYTES 16
#endif
template <typename T>
struct Pack {
  typedef T type __attribute__((vector_size(LANES_BYTES)));
};
template <typename T>
using Lanes = typename Pack<T>::type;
template <typename T>
constexpr int WIDTH = LANES_BYTES / sizeof(T);

// Memory that was given back is given out again, by each thread: that of aligned vectors takes long to find.
template <class S>
struct Kept {
  typedef S value_type;
  Kept() {}
  template <class O>
  Kept(const Kept<O>&) {}
  static std::vector<void*>& shelf(size_t count, size_t& bytes) {
    static thread_local auto* shelves = new std::vector<void*>[64];  // never gone: others may end later than it would
    int k = 6;
    while ((size_t(1) << k) < count * sizeof(S)) ++k;
    bytes = size_t(1) << k;
    return shelves[k];
  }
  S* allocate(size_t count) {
    size_t bytes;
    std::vector<void*>& free = shelf(count, bytes);
    void* found = free.empty() ? std::aligned_alloc(64, bytes) : free.back();
    if (!found) throw std::bad_alloc();
    if (!free.empty()) free.pop_back();
    return static_cast<S*>(found);
  }
  void deallocate(S* gone, size_t count) {
    size_t bytes;
    shelf(count, bytes).push_back(gone);
  }
  template <class O>
  bool operator==(const Kept<O>&) const { return true; }
  template <class O>
  bool operator!=(const Kept<O>&) const { return false; }
};
template <class S>
using List = std::vector<S, Kept<S>>;

template <typename T>
static inline Lanes<T> load(const T* from, int64_t count) {
  Lanes<T> x = Lanes<T>{} + *from;  // lanes behind the end do what the first does
  if (count >= WIDTH<T>)
    std::memcpy(&x, from, sizeof(x));
  else
    std::memcpy(&x, from, count * sizeof(T));
  return x;
}

template <typename T>
static inline void store(T* to, const Lanes<T>& x, int64_t count) {
  if (count >= WIDTH<T>)
    std::memcpy(to, &x, sizeof(x));
  else
    std::memcpy(to, &x, count * sizeof(T));
}

// Moves a block of scenes between arrays (rows, scenes), one per field, and structs of lanes.
template <typename T, class S, class A>
static void fetch(std::vector<S, A>& to, const T* const* from, int64_t b, int64_t scenes) {
  const int64_t rows = to.size(), fields = sizeof(S) / sizeof(Lanes<T>);
  for (int64_t r = 0; r < rows; ++r)
    for (int64_t f = 0; f < fields; ++f) ((Lanes<T>*)&to[r])[f] = load(from[f] + r * scenes + b, scenes - b);
}
template <typename T, class S, class A>
static void put(const std::vector<S, A>& from, T* const* to, int64_t b, int64_t scenes) {
  const int64_t rows = from.size(), fields = sizeof(S) / sizeof(Lanes<T>);
  for (int64_t r = 0; r < rows; ++r)
    for (int64_t f = 0; f < fields; ++f)
      store<T>(to[f] + r * scenes + b, ((const Lanes<T>*)&from[r])[f], scenes - b);
}

template <typename T>
static inline Lanes<T> root(const Lanes<T>& x) {
  Lanes<T> y;
  for (int i = 0; i < WIDTH<T>; ++i) y[i] = std::sqrt(x[i]);
  return y;
}

// Whether a comparison holds in any lane.
template <typename M>
static inline bool any(const M& mask) {
  int64_t part[sizeof(M) / 8], whole = 0;
  std::memcpy(part, &mask, sizeof(part));
  for (const int64_t x : part) whole |= x;
  return whole != 0;
}

// The same code runs on GPUs, see simt.h, where the lanes of a warp share what is done for each scene: one loop of all,
// sums of which each adds a part, numbers that all lanes may set or read.
#define CALLED
#define EVERY(i, n) for (int i = 0; i < int(n); ++i)
#define ADD(to, ...) (to) += __VA_ARGS__
static inline int lane() { return 0; }
static inline void meet() {}
static inline bool anyone(bool yes) { return yes; }
template <typename T>
static inline T total(T mine) {
  return mine;
}
template <typename T, class S>
struct Own {  // what a lane adds to a sum of all; see simt.h
  S& sum;
  explicit Own(S& to) : sum(to) {}
};
template <class S>
static inline void blank(List<S>& list) {
  list.assign(list.size(), S{});
}
template <class S>
static inline void copy(const List<S>& from, List<S>& to) {
  to = from;
}
struct Memory {
  template <class S>
  void common(List<S>& list, int64_t count) { list.resize(count); }
  template <class S>
  void large(List<S>& list, int64_t count) { list.resize(count); }
  template <class S>
  void own(List<S>& list, int64_t, int64_t = 1) { list.clear(); }
};
#endif

// A length below which vectors count as zero, as in physics/linalg/numerics.py.
template <typename T>
constexpr T TINY = sizeof(T) == 8 ? T(1e-12) : T(1e-8);

#ifdef SIMT
// Not all compilers have arrays of no numbers.
template <typename T>
struct Nothing {
  Lanes<T> operator[](int) const { return {}; }
};
template <typename T, int N>
struct Derivatives {
  Lanes<T> g[N];
};
template <typename T>
struct Derivatives<T, 0> {
  static constexpr Nothing<T> g{};
};
#endif

// A number with its derivatives by N variables; N may be 0.
template <typename T, int N>
#ifdef SIMT
struct Num : Derivatives<T, N> {
  using Derivatives<T, N>::g;
  Lanes<T> x;
#else
struct Num {
  Lanes<T> x;
  Lanes<T> g[N];
#endif
  Num() {}
  Num(const Lanes<T>& value) : x(value) {
    for (int i = 0; i < N; ++i) g[i] = Lanes<T>{};
  }
  Num(T value) : Num(Lanes<T>{} + value) {}
  static Num variable(const Lanes<T>& value, int place) {
    Num a(value);
    if (N) a.g[place] += T(1);
    return a;
  }
};

#define NUM template <typename T, int N> static inline Num<T, N>

NUM operator+(const Num<T, N>& a, const Num<T, N>& b) {
  Num<T, N> c;
  c.x = a.x + b.x;
  for (int i = 0; i < N; ++i) c.g[i] = a.g[i] + b.g[i];
  return c;
}
NUM operator-(const Num<T, N>& a, const Num<T, N>& b) {
  Num<T, N> c;
  c.x = a.x - b.x;
  for (int i = 0; i < N; ++i) c.g[i] = a.g[i] - b.g[i];
  return c;
}
NUM operator-(const Num<T, N>& a) {
  Num<T, N> c;
  c.x = -a.x;
  for (int i = 0; i < N; ++i) c.g[i] = -a.g[i];
  return c;
}
NUM operator*(const Num<T, N>& a, const Num<T, N>& b) {
  Num<T, N> c;
  c.x = a.x * b.x;
  for (int i = 0; i < N; ++i) c.g[i] = a.g[i] * b.x + a.x * b.g[i];
  return c;
}
NUM operator/(const Num<T, N>& a, const Num<T, N>& b) {
  Num<T, N> c;
  c.x = a.x / b.x;
  const Lanes<T> inverse = T(1) / b.x;
  for (int i = 0; i < N; ++i) c.g[i] = (a.g[i] - c.x * b.g[i]) * inverse;
  return c;
}
NUM root(const Num<T, N>& a) {
  Num<T, N> c;
  c.x = root<T>(a.x);
  const Lanes<T> half = T(0.5) / c.x;
  for (int i = 0; i < N; ++i) c.g[i] = half * a.g[i];
  return c;
}
template <typename T, int N, typename M>
static inline Num<T, N> select(const M& mask, const Num<T, N>& yes, const Num<T, N>& no) {
  Num<T, N> c;
  c.x = mask ? yes.x : no.x;
  for (int i = 0; i < N; ++i) c.g[i] = mask ? yes.g[i] : no.g[i];
  return c;
}
NUM larger(const Num<T, N>& a, const Num<T, N>& b) { return select(a.x >= b.x, a, b); }
NUM smaller(const Num<T, N>& a, const Num<T, N>& b) { return select(a.x <= b.x, a, b); }
// What is not a number stays so.
NUM positive(const Num<T, N>& a) { return select(a.x < T(0), Num<T, N>(T(0)), a); }
NUM magnitude(const Num<T, N>& a) { return select(a.x < T(0), -a, a); }

// Three numbers.
template <typename T>
struct Vec {
  Lanes<T> x, y, z;
  Vec operator+(const Vec& o) const { return {x + o.x, y + o.y, z + o.z}; }
  Vec operator-(const Vec& o) const { return {x - o.x, y - o.y, z - o.z}; }
  Vec operator-() const { return {-x, -y, -z}; }
  Vec operator*(const Lanes<T>& k) const { return {x * k, y * k, z * k}; }
  Vec times(const Vec& o) const { return {x * o.x, y * o.y, z * o.z}; }
  void operator+=(const Vec& o) { x += o.x, y += o.y, z += o.z; }
  void operator-=(const Vec& o) { x -= o.x, y -= o.y, z -= o.z; }
};
template <typename T>
static inline Lanes<T> dot(const Vec<T>& a, const Vec<T>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <typename T>
static inline Vec<T> cross(const Vec<T>& a, const Vec<T>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
#ifdef SIMT
template <typename T>
static inline void add_number(Vec<T>& to, const Vec<T>& x) {
  ADD(to.x, x.x), ADD(to.y, x.y), ADD(to.z, x.z);
}
#endif
