// How kernels of rods are called from `lanes.py`: inputs read where they are, results next to each other.
#pragma once
#include <vector>

#include "banded.h"
#include "flush.h"
#include "lanes.h"

// Where a component of an input stands.
struct Place {
  int64_t input, offset, slot, scene;  // steps between slots and scenes are 0 for one
};

struct Call {
  int64_t slots, scenes;
  const Place* places;
  const int64_t* after;
  const double* numbers;
  int64_t half, count;  // of the pattern, where a system is solved
  const int32_t *pattern, *order;
};

template <typename T>
static Lanes<T> at_least(const Lanes<T>& x, T least) {
  return x < least ? Lanes<T>{} + least : x;
}

// Zero vectors have length zero.
template <typename T>
static Lanes<T> length(const Vec<T>& x) {
  const Lanes<T> squared = dot(x, x);
  return squared <= TINY<T> * TINY<T> ? Lanes<T>{} : root<T>(squared);
}

// The edge from one vertex to the next: a unit vector on dummy edges.
template <typename T>
static Vec<T> edge(const Vec<T>& start, const Vec<T>& end, const Lanes<T>& mask) {
  const Vec<T> e = end - start;
  const auto real = mask > T(0);
  return {real ? e.x : Lanes<T>{} + T(1), real ? e.y : Lanes<T>{}, real ? e.z : Lanes<T>{}};
}

// Room that a thread keeps from call to call.
template <typename T>
class Scratch {
 public:
  template <class S = Lanes<T>>
  S* take(int64_t count) {
    const size_t size = count * sizeof(S) / sizeof(Lanes<T>);
    if (used_ == rooms.size()) rooms.emplace_back();
    std::vector<Lanes<T>>& room = rooms[used_++];
    if (room.size() < size) room.resize(size);
    return (S*)room.data();
  }

 private:
  static inline thread_local std::vector<std::vector<Lanes<T>>> rooms;
  size_t used_ = 0;
};

static std::vector<int64_t> preceding(const Call& call) {
  std::vector<int64_t> found(call.slots);
  for (int64_t i = 0; i < call.slots; ++i) found[call.after[i]] = i;
  return found;
}

// Results of a block of scenes, (components, slots, scenes).
template <typename T>
struct Out {
  T* to;
  const Call& call;
  int64_t b;
  void put(int component, int64_t i, const Lanes<T>& x) const {
    store<T>(to + (component * call.slots + i) * call.scenes + b, x, call.scenes - b);
  }
  void put(int component, int64_t i, const Vec<T>& x) const {
    put(component, i, x.x);
    put(component + 1, i, x.y);
    put(component + 2, i, x.z);
  }
};

template <typename T, class Kernel>
static void blocks(const T* const* from, T* to, const Call& call, int threads) {
  const int64_t count = (call.scenes + WIDTH<T> - 1) / WIDTH<T>, own = sizeof(typename Kernel::In) / sizeof(Lanes<T>);
#pragma omp parallel num_threads(threads) if (threads > 1 && count > 1)
  {
    const FlushTiny flush;
    Scratch<T> scratch;
    typename Kernel::In* slot = scratch.template take<typename Kernel::In>(call.slots);
    Kernel kernel(call, scratch);
#pragma omp for schedule(static)
    for (int64_t block = 0; block < count; ++block) {
      const int64_t b = block * WIDTH<T>;
      for (int64_t f = 0; f < own; ++f) {
        const Place& p = call.places[f];
        const T* at = from[p.input] + p.offset + (p.scene ? b : 0);
        for (int64_t i = 0; i < call.slots; ++i, at += p.slot)
          ((Lanes<T>*)&slot[i])[f] = p.scene ? load(at, call.scenes - b) : Lanes<T>{} + *at;
      }
      kernel(slot, Out<T>{to, call, b});
    }
  }
}
