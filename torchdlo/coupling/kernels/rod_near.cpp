// Which pairs of edges of ropes can touch before the next look, and whether vertices outran it; see broad_phase.py and
// `RodContact` in rod_contact_effect.py.
//
// All arrays have the scenes last: (V, B) for numbers of vertices, (4, K, B) for the places v B + b of the corners of
// pairs, (K, B) for whether they are pairs.
#include "segments.h"

struct Sizes {
  int64_t vertices, scenes, held, rods, room, few, apart;
  const int64_t *counts, *closed;  // of each rod
  double dt, burst;
};

#ifdef SIMT
#include "rod_near_simt.h"
#else
#include <algorithm>
#include <memory>

#include "flush.h"

template <typename T>
struct Scene {
  typedef Num<T, 0> P;
  typedef Three<T, 0> V;
  static constexpr int W = WIDTH<T>;
  static constexpr int64_t CELLS = 1 << 20;  // per axis
  const Sizes& n;
  const int64_t b;
  std::vector<int> after, rod, edges;
  std::vector<T> pos, middle, wide, radius, length, start, whole;
  std::vector<int> first, second;  // what is found
  int some[2][W], many = 0;        // pairs whose middles are near, side by side
  T reach = 0;

  Scene(const Sizes& n, int64_t b) : n(n), b(b), after(n.vertices), rod(n.vertices) {
    int v = 0;
    for (int k = 0; k < n.rods; ++k) {
      const int from = v, to = v + int(n.counts[k]);
      for (; v < to; ++v) {
        after[v] = v + 1 < to ? v + 1 : from, rod[v] = k;
        if (v + 1 < to || n.closed[k]) edges.push_back(v);
      }
    }
  }
  std::vector<T> read(const T* const* from, int fields) const {
    std::vector<T> to(fields * n.vertices);
    for (int f = 0; f < fields; ++f)
      for (int v = 0; v < n.vertices; ++v) to[f * n.vertices + v] = from[f][v * n.scenes + b];
    return to;
  }

  // How far the fastest vertex may go beside the mean of all, and so may held ones.
  void foresee(const T* const* vel, const T* const* carried, const T* const* thick) {
    T mean[3] = {}, most = 0;
    for (int k = 0; k < 3; ++k) {
      for (int v = 0; v < n.vertices; ++v) mean[k] += vel[k][v * n.scenes + b];
      mean[k] /= T(n.vertices);
    }
    const auto compare = [&](const T* const* x, int64_t count, T scale) {
      for (int64_t v = 0; v < count; ++v) {
        T squared = 0;
        for (int k = 0; k < 3; ++k) {
          const T d = x[k][v * n.scenes + b] * scale - mean[k];
          squared += d * d;
        }
        if (!(squared <= most)) most = squared;  // what is not a number stays so
      }
    };
    compare(vel, n.vertices, T(1)), compare(carried, n.held, T(1 / n.dt));
    // Without a given burst: 1 m/s, or half a radius within the step.
    T sudden = T(n.dt) * (n.burst < 0 ? T(1) : T(n.burst));
    if (n.burst < 0)
      for (int v = 0; v < n.vertices; ++v) sudden = std::min(sudden, T(0.5) * thick[0][v * n.scenes + b]);
    reach = T(n.dt) * T(1.5) * std::sqrt(most) + sudden;
  }

  void prepare(const T* const* at, const T* const* thick, const T* const* rest) {
    const int size = int(n.vertices);
    pos = read(at, 3), radius = read(thick, 1), length = read(rest, 1);
    middle.assign(3 * size, T(0)), wide.assign(size, T(0)), start.assign(size, T(0)), whole.assign(n.rods, T(0));
    T sum = 0;
    for (int v : edges) {
      const int w = after[v];
      T squared = 0;
      for (int k = 0; k < 3; ++k) {
        const T d = pos[k * size + w] - pos[k * size + v];
        squared += d * d, middle[k * size + v] = T(0.5) * (pos[k * size + v] + pos[k * size + w]);
      }
      wide[v] = T(0.5) * std::sqrt(squared) + radius[v] + reach;
      start[v] = sum, sum += length[v], whole[rod[v]] += length[v];
    }
  }

  // Whether edges are of different rods, or far enough along one for it to come back to itself.
  bool separate(int i, int j) const {
    if (rod[i] != rod[j]) return true;
    const int k = rod[i];
    const bool closed = n.closed[k];
    const int64_t steps = closed ? std::min<int64_t>(j - i, n.counts[k] - (j - i)) : j - i;
    const T between = start[j] - start[i] - length[i], back = whole[k] - between - length[i] - length[j];
    const T arc = closed && back < between ? back : between, thick = radius[i] + radius[j];
    return steps >= n.apart && arc >= T(1.5707963267948966) * thick;
  }
  void offer(int a, int b) {
    const int i = std::min(a, b), j = std::max(a, b);
    if (!separate(i, j)) return;
    some[0][many] = i, some[1][many] = j;
    if (++many == W) measure();
  }
  // Keeps those pairs whose edges are near.
  void measure() {
    V p[4];
    for (int c = 0; c < 4; ++c)
      for (int k = 0; k < 3; ++k)
        for (int i = 0; i < many; ++i) {
          const int v = some[c / 2][i];
          (&p[c].x)[k].x[i] = pos[k * n.vertices + (c % 2 ? after[v] : v)];
        }
    P s, t;
    closest(p, s, t);
    V way;
    const P apart = measured(p[0] + (p[1] - p[0]) * s - p[2] - (p[3] - p[2]) * t, way);
    for (int i = 0; i < many; ++i) {
      const int u = some[0][i], v = some[1][i];
      if (apart.x[i] <= radius[u] + radius[v] + 2 * reach) first.push_back(u), second.push_back(v);
    }
    many = 0;
  }
  bool near(int a, int b) const {
    T squared = 0;
    const T limit = wide[a] + wide[b];
    for (int k = 0; k < 3; ++k) {
      const T d = middle[k * n.vertices + a] - middle[k * n.vertices + b];
      squared += d * d;
    }
    return squared <= limit * limit;
  }

  // Several at a time: most are far from each other.
  void try_all() {
    const size_t count = edges.size();
    std::vector<T> packed[4];
    for (int k = 0; k < 4; ++k) {
      packed[k].resize(count + W);
      for (size_t i = 0; i < count; ++i) packed[k][i] = (k < 3 ? middle[k * n.vertices + edges[i]] : wide[edges[i]]);
    }
    for (size_t i = 0; i < count; ++i)
      for (size_t j = i + 1; j < count; j += W) {
        Lanes<T> squared{};
        for (int k = 0; k < 3; ++k) {
          const Lanes<T> d = load(&packed[k][j], W) - packed[k][i];
          squared += d * d;
        }
        const Lanes<T> limit = load(&packed[3][j], W) + packed[3][i];
        if (!any(squared <= limit * limit)) continue;
        for (size_t other = j; other < std::min(j + W, count); ++other)
          if (near(edges[i], edges[other])) offer(edges[i], edges[other]);
      }
  }
  // Cells as wide as two middles can be apart: an edge is tried with the ones behind it in its own row of cells, and
  // with those of the four rows that come after it. Both ends of such a run move on with the edge.
  void try_cells() {
    T low[3], cell = 0;
    for (int k = 0; k < 3; ++k) {
      const T* x = &middle[k * n.vertices];
      low[k] = x[edges[0]];
      for (int v : edges) low[k] = std::min(low[k], x[v]), cell = std::max(cell, 2 * wide[v]);
    }
    std::vector<std::pair<int64_t, int>> sorted;
    for (int v : edges) {
      int64_t key = 0;
      for (int k = 3; k--;) {
        const T place = std::floor((middle[k * n.vertices + v] - low[k]) / cell);
        key = key * CELLS + 1 + (place > T(0) ? int64_t(std::min(place, T(CELLS - 4))) : 0);
      }
      sorted.push_back({key, v});
    }
    std::sort(sorted.begin(), sorted.end());
    const size_t count = sorted.size();
    for (const int64_t step : {int64_t(0), CELLS, CELLS * CELLS - CELLS, CELLS * CELLS, CELLS * CELLS + CELLS})
      for (size_t k = 0, begin = 0, end = 0; k < count; ++k) {
        const int64_t key = sorted[k].first + step;
        while (begin < count && (step ? sorted[begin].first < key - 1 : begin <= k)) ++begin;
        while (end < count && sorted[end].first <= key + 1) ++end;
        for (size_t other = begin; other < end; ++other)
          if (near(sorted[k].second, sorted[other].second)) offer(sorted[k].second, sorted[other].second);
      }
  }

  void find() {
    if (n.vertices <= n.few)
      try_all();
    else
      try_cells();
    if (many) measure();
  }
  void write(int64_t* at, T* real, T* lost) const {
    const int64_t found = int64_t(first.size());
    for (int64_t k = 0; k < n.room; ++k) {
      const int i = k < found ? first[k] : edges[0], j = k < found ? second[k] : edges[0];
      const int corner[4] = {i, after[i], j, after[j]};
      for (int c = 0; c < 4; ++c) at[(c * n.room + k) * n.scenes + b] = corner[c] * n.scenes + b;
      real[k * n.scenes + b] = T(k < found);
    }
    lost[b] = T(std::max<int64_t>(found - n.room, 0));
  }
};

#define SCENES                                                            \
  _Pragma("omp parallel for schedule(static, 8) num_threads(threads)") \
  for (int64_t b = 0; b < n.scenes; ++b) if (const FlushTiny flush; true)

template <typename T>
static void look(const T* const* rods, const T* const* carried, int64_t* at, T* real, T* lost, T* reach,
                 const Sizes& n, int threads) {
  SCENES {
    Scene<T> scene(n, b);
    scene.foresee(rods + 3, carried, rods + 6);
    scene.prepare(rods, rods + 6, rods + 7);
    scene.find();
    scene.write(at, real, lost);
    reach[b] = scene.reach;
  }
}

// By how far vertices went beyond what was foreseen, beside the mean of all.
template <typename T>
static void outrun(const T* const* pos, const T* const* origin, const T* reach, T* beyond, const Sizes& n,
                   int threads) {
  SCENES {
    T mean[3] = {}, most = 0;
    for (int k = 0; k < 3; ++k) {
      for (int64_t i = b; i < n.vertices * n.scenes; i += n.scenes) mean[k] += pos[k][i] - origin[k][i];
      mean[k] /= T(n.vertices);
    }
    for (int64_t i = b; i < n.vertices * n.scenes; i += n.scenes) {
      T squared = 0;
      for (int k = 0; k < 3; ++k) {
        const T d = pos[k][i] - origin[k][i] - mean[k];
        squared += d * d;
      }
      if (!(squared <= most)) most = squared;
    }
    const T over = std::sqrt(most) - reach[b];
    beyond[b] = over < T(0) ? T(0) : over;
  }
}

#define ENTRY(name, T)                                                                                           \
  extern "C" void name##_look(const T* const* rods, const T* const* carried, int64_t* at, T* real, T* lost,      \
                              T* reach, const Sizes* n, int threads) {                                           \
    look<T>(rods, carried, at, real, lost, reach, *n, threads);                                                  \
  }                                                                                                              \
  extern "C" void name##_outrun(const T* const* pos, const T* const* origin, const T* reach, T* beyond,          \
                                const Sizes* n, int threads) {                                                   \
    outrun<T>(pos, origin, reach, beyond, *n, threads);                                                          \
  }
ENTRY(rod_near_float, float)
ENTRY(rod_near_double, double)
#endif
