// Where along edges they are nearest to a body, without the last step of Newton's method; see segment_distance.py.
//
// Edges of all scenes stand side by side: (vertices, scenes) for each number of theirs, (scenes) for those of the body.
#include "edge_points.h"
#include "flush.h"

#include <algorithm>

struct Sizes {
  int64_t vertices, scenes, shape, pieces;
  const int64_t* cells;
  const void* grid;
};

template <typename T>
static void search(const T* const* edges, const T* const* body, T* const* out, const Sizes& n, int threads) {
  const int64_t all = n.vertices * n.scenes;
  const Grid<T> grid = {(const T*)n.grid, n.cells};
  _Pragma("omp parallel for num_threads(threads) if (threads > 1)")
  for (int64_t i = 0; i < all; i += WIDTH<T>) {
    const FlushTiny flush;
    const int64_t count = std::min<int64_t>(WIDTH<T>, all - i);
    Lanes<T> at[6], size[4];
    for (int k = 0; k < 6; ++k) at[k] = load(edges[k] + i, count);
    for (int k = 0; k < 4; ++k)
      for (int l = 0; l < WIDTH<T>; ++l) size[k][l] = body[k][(l < count ? i + l : i) % n.scenes];
    const Line<T, 0> line(int(n.shape), grid, {at[0], at[1], at[2]}, {at[3], at[4], at[5]}, size);
    for (int j = 0; j < n.pieces; ++j) {
      const Found<T> f = nearest(line, T(j) / n.pieces, T(j + 1) / n.pieces);
      store(out[4 * j] + i, f.share, count);
      store(out[4 * j + 1] + i, f.steep, count);
      store(out[4 * j + 2] + i, f.left, count);
      store(out[4 * j + 3] + i, f.right, count);
    }
  }
}

#define ENTRY(name, T)                                                                                      \
  extern "C" void name##_search(const T* const* edges, const T* const* body, T* const* out, const Sizes* n, \
                                int threads) {                                                              \
    search<T>(edges, body, out, *n, threads);                                                               \
  }
ENTRY(edge_search_float, float)
ENTRY(edge_search_double, double)
