// What lanes.h is on a GPU: one scene per warp, one number per lane, lists in memory that the caller gives. All lanes of
// a warp run the same code; each takes its share of the loops that say EVERY, and what several add to is added to by ADD.
//
// With EMULATED a CPU runs it, with threads in place of lanes: so it is tested where there is no GPU.
#pragma once

#ifdef EMULATED
#include <pthread.h>

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <limits>
#ifndef WARP
#define WARP 4
#endif
struct Warp {  // what its lanes share
  pthread_barrier_t barrier;
  int64_t block, blocks;
  char* shared;
  double numbers[WARP];
};
static thread_local Warp* warp;
static thread_local int own_lane;
static inline int lane() { return own_lane; }
static inline int64_t first_scene() { return warp->block; }
static inline int64_t scene_step() { return warp->blocks; }
static inline char* shared_memory() { return warp->shared; }
// Waits for the other lanes: what they wrote before can be read then.
static inline void meet() { pthread_barrier_wait(&warp->barrier); }
// What `join` makes of the numbers of all lanes; it must not matter in which order.
template <typename T, typename J>
static inline T everyones(T mine, J join) {
  warp->numbers[own_lane] = double(mine);
  meet();
  T all = T(warp->numbers[0]);
  for (int i = 1; i < WARP; ++i) all = join(all, T(warp->numbers[i]));
  meet();
  return all;
}
// How many lanes before this one say yes, and how many do in all.
static inline int ahead(bool yes, int& all) {
  warp->numbers[own_lane] = yes;
  meet();
  int found = 0;
  all = 0;
  for (int i = 0; i < WARP; ++i) all += warp->numbers[i] > 0, found += i < own_lane && warp->numbers[i] > 0;
  meet();
  return found;
}
template <typename T>
static inline void add_number(T& to, T x) {
  T old, now;
  __atomic_load(&to, &old, __ATOMIC_RELAXED);
  do now = old + x;
  while (!__atomic_compare_exchange(&to, &old, &now, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED));
}
#else
#define WARP 32
typedef long long int64_t;
namespace std {
using ::cos;
using ::floor;
using ::sin;
using ::sqrt;
template <typename T>
struct numeric_limits;
template <>
struct numeric_limits<float> {
  static constexpr float min() { return 1.17549435e-38f; }
};
template <>
struct numeric_limits<double> {
  static constexpr double min() { return 2.2250738585072014e-308; }
};
}  // namespace std
extern __shared__ __align__(16) char shared_bytes[];
static inline int lane() { return threadIdx.x; }
static inline int64_t first_scene() { return blockIdx.x; }
static inline int64_t scene_step() { return gridDim.x; }
static inline char* shared_memory() { return shared_bytes; }
static inline void meet() { __syncwarp(); }
template <typename T, typename J>
static inline T everyones(T mine, J join) {
  for (int step = 16; step; step /= 2) mine = join(mine, __shfl_xor_sync(0xffffffffu, mine, step));
  return mine;
}
static inline int ahead(bool yes, int& all) {
  const unsigned mask = __ballot_sync(0xffffffffu, yes);
  all = __popc(mask);
  return __popc(mask & ((1u << lane()) - 1u));
}
template <typename T>
static inline void add_number(T& to, T x) {
  atomicAdd(&to, x);
}
#endif

struct Bits {  // a comparison
  bool on;
  explicit operator bool() const { return on; }
};
static inline Bits operator&(Bits a, Bits b) { return {a.on && b.on}; }
static inline Bits operator|(Bits a, Bits b) { return {a.on || b.on}; }
static inline Bits operator~(Bits a) { return {!a.on}; }

template <typename T>
struct One {
  T v;
  T& operator[](int) { return v; }
  const T& operator[](int) const { return v; }
  One operator-() const { return {-v}; }
#define BOTH(result, op)                                                          \
  friend inline result operator op(const One& a, const One& b) { return {a.v op b.v}; } \
  friend inline result operator op(const One& a, T b) { return {a.v op b}; }      \
  friend inline result operator op(T a, const One& b) { return {a op b.v}; }
  BOTH(One, +) BOTH(One, -) BOTH(One, *) BOTH(One, /)
  BOTH(Bits, <) BOTH(Bits, >) BOTH(Bits, <=) BOTH(Bits, >=) BOTH(Bits, ==)
#undef BOTH
  void operator+=(const One& o) { v += o.v; }
  void operator+=(T o) { v += o; }
  void operator-=(const One& o) { v -= o.v; }
};
template <typename T>
using Lanes = One<T>;
template <typename T>
constexpr int WIDTH = 1;

static inline bool any(const Bits& mask) { return mask.on; }
template <typename T>
static inline Lanes<T> root(const Lanes<T>& x) {
  return {T(std::sqrt(x.v))};
}
template <typename T>
static inline void add_number(One<T>& to, const One<T>& x) {
  add_number(to.v, x.v);
}

// A list as std::vector is one, in memory that `Memory` gave it and that it cannot outgrow.
template <class S>
struct List {
  S* at;
  int64_t many;
  S& operator[](int64_t i) { return at[i]; }
  const S& operator[](int64_t i) const { return at[i]; }
  S* data() { return at; }
  const S* data() const { return at; }
  S* begin() { return at; }
  S* end() { return at + many; }
  const S* begin() const { return at; }
  const S* end() const { return at + many; }
  S& back() { return at[many - 1]; }
  int64_t size() const { return many; }
  bool empty() const { return !many; }
  void clear() { many = 0; }
  void resize(int64_t count) { many = count; }
  void push_back(const S& x) { at[many++] = x; }
  void emplace_back() { ++many; }
  void swap(List& o) {
    const List kept = *this;
    *this = o, o = kept;
  }
};

// What is better called than written out at every place where it is used: compilers are done sooner.
#ifdef EMULATED
#define CALLED
#else
#define CALLED __noinline__
#endif

#define EVERY(i, n) for (int i = lane(); i < (n); i += WARP)
#define ADD(to, ...) add_number(to, __VA_ARGS__)

// Sets all numbers of a list that lanes share.
template <class S>
static inline void blank(List<S>& list) {
  EVERY(i, list.size()) list[i] = S{};
}
template <class S>
static inline void copy(const List<S>& from, List<S>& to) {
  EVERY(i, from.size()) to[i] = from[i];
}
// Whether any lane says so.
static inline bool anyone(bool yes) {
  int all;
  ahead(yes, all);
  return all > 0;
}
template <typename T>
static inline T total(T mine) {
  return everyones(mine, [](T a, T b) { return a + b; });
}
// What a lane adds to a sum of all, which it is added to in the end; all lanes have one at the same time.
template <typename T, class S>
struct Own {
  S sum{};
  S& to;
  explicit Own(S& to) : to(to) {}
  ~Own() {
    constexpr int numbers = sizeof(S) / sizeof(T);
#ifndef EMULATED
#pragma unroll
#endif
    for (int i = 0; i < numbers; ++i) {
      const T all = total(((const T*)&sum)[i]);
      if (lane() == 0) ((T*)&to)[i] += all;
    }
  }
};

// Moves a scene between arrays (rows, scenes), one per field, and structs.
template <typename T, class S>
static void fetch(List<S>& to, const T* const* from, int64_t b, int64_t scenes) {
  const int fields = sizeof(S) / sizeof(T);
  for (int f = 0; f < fields; ++f) EVERY(r, to.size()) ((T*)&to[r])[f] = from[f][r * scenes + b];
}
template <typename T, class S>
static void put(const List<S>& from, T* const* to, int64_t b, int64_t scenes) {
  const int fields = sizeof(S) / sizeof(T);
  for (int f = 0; f < fields; ++f) EVERY(r, from.size()) to[f][r * scenes + b] = ((const T*)&from[r])[f];
}

// What a kernel is called with: addresses of arrays, one per field, and memory.
struct Fields {
  void* at[176];
  template <typename T>
  T* const* from(int k) const {
    return (T* const*)(at + k);
  }
};
// Memory of a warp. Without an address it only counts.
struct Memory {
  char *near, *far;             // what is fast, and what is large
  int64_t nearby = 0, away = 0;  // bytes that are taken
  // For all lanes together.
  template <class S>
  void common(List<S>& list, int64_t count) {
    list = {(S*)(near + nearby), count}, nearby += rounded(count * sizeof(S));
  }
  template <class S>
  void large(List<S>& list, int64_t count) {
    list = {(S*)(far + away), count}, away += rounded(count * sizeof(S));
  }
  // For each lane by itself, empty at first, with room for `times` as many as it gets of EVERY(i, count).
  template <class S>
  void own(List<S>& list, int64_t count, int64_t times = 1) {
    const int64_t bytes = rounded((count + WARP - 1) / WARP * times * sizeof(S));
    list = {(S*)(far + away + lane() * bytes), 0}, away += WARP * bytes;
  }
  // Says what it counted, in place of an array.
  void report(const Fields& p) const {
    if (lane() == 0) ((int64_t*)p.at[0])[0] = nearby, ((int64_t*)p.at[0])[1] = away;
  }
  static int64_t rounded(int64_t bytes) { return (bytes + 15) / 16 * 16; }
};

struct Room {
  char* far;
  int64_t each, nearby;  // bytes of each warp in `far`; how many of them are for what is fast, if that is not shared
  Memory memory() const {
    char* own = far + first_scene() * each;
    return nearby ? Memory{own, own + nearby} : Memory{shared_memory(), own};
  }
};

// KERNEL(name, Sizes) { ... } is what each warp does with sizes `n`, arrays `p` and memory `room`.
#ifdef EMULATED
#include <thread>
#include <vector>
template <class S>
static void emulate(void (*run)(const S&, const Fields&, const Room&), const S* n, const Fields* p, const Room* room,
                    int64_t blocks, int64_t shared) {
  for (int64_t b = 0; b < blocks; ++b) {
    Warp all;
    std::vector<double> memory(shared / 8 + 1);
    pthread_barrier_init(&all.barrier, nullptr, WARP);
    all.block = b, all.blocks = blocks, all.shared = (char*)memory.data();
    std::vector<std::thread> lanes;
    for (int i = 0; i < WARP; ++i)
      lanes.emplace_back([&, i] {
        warp = &all, own_lane = i;
        run(*n, *p, *room);
      });
    for (std::thread& each : lanes) each.join();
    pthread_barrier_destroy(&all.barrier);
  }
}
#define KERNEL(name, S)                                                                                              \
  static void name##_lane(const S& n, const Fields& p, const Room& room);                                            \
  extern "C" void name(const S* n, const Fields* p, const Room* room, int64_t blocks, int64_t shared) {              \
    emulate<S>(name##_lane, n, p, room, blocks, shared);                                                             \
  }                                                                                                                  \
  static void name##_lane(const S& n, const Fields& p, const Room& room)
#else
#define KERNEL(name, S) \
  extern "C" __global__ void name(const __grid_constant__ S n, const __grid_constant__ Fields p, const __grid_constant__ Room room)
#endif
