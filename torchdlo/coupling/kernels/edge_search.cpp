// Where along edges they are nearest to a body, without the last step of Newton's method; see segment_distance.py.
//
// Edges of all scenes stand side by side: (vertices, scenes) for each number of theirs, (scenes) for those of the body.
// `points` does the whole of it for all bodies: share, distance, normal and arm, (families, vertices, scenes) each.
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

struct AllSizes {
  int64_t vertices, scenes, bodies, corners;
  const int64_t *shape, *pieces, *after, *cells;
  const void* grids;
};

template <typename T>
static void points(const T* const* pos, const T* const* bodies, T* const* out, const AllSizes& n, int threads) {
  typedef Lanes<T> L;
  const int64_t all = n.vertices * n.scenes;
  _Pragma("omp parallel for num_threads(threads) if (threads > 1)")
  for (int64_t i = 0; i < all; i += WIDTH<T>) {
    const FlushTiny flush;
    const int64_t count = std::min<int64_t>(WIDTH<T>, all - i);
    int64_t next[WIDTH<T>], scene[WIDTH<T>];
    L here[3], there[3];
    for (int l = 0; l < WIDTH<T>; ++l) {
      const int64_t at = l < count ? i + l : i;
      scene[l] = at % n.scenes, next[l] = n.after[at / n.scenes] * n.scenes + scene[l];
    }
    for (int c = 0; c < 3; ++c) {
      here[c] = load(pos[c] + i, count);
      for (int l = 0; l < WIDTH<T>; ++l) there[c][l] = pos[c][next[l]];
    }
    int64_t family = 0;
    for (int64_t k = 0; k < n.bodies; ++k) {
      L body[17];  // place, axes, offset of its shape, and the shape's size
      for (int q = 0; q < 17; ++q)
        for (int l = 0; l < WIDTH<T>; ++l) body[q][l] = bodies[q][k * n.scenes + scene[l]];
      const Grid<T> grid = {(const T*)n.grids + k * n.corners, n.cells + 3 * k};
      const int shape = int(n.shape[k]);
      L arm[2][3], at[2][3];
      for (int c = 0; c < 3; ++c) arm[0][c] = here[c] - body[c], arm[1][c] = there[c] - body[c];
      for (int e = 0; e < 2; ++e)
        for (int c = 0; c < 3; ++c) {
          const L* axis = body + 3 + 3 * c;
          at[e][c] = axis[0] * arm[e][0] + axis[1] * arm[e][1] + axis[2] * arm[e][2];
        }
      for (int e = 0; e < 2; ++e) at[e][0] += body[12];
      const Line<T, 0> line(shape, grid, {at[0][0], at[0][1], at[0][2]},
                            {at[1][0] - at[0][0], at[1][1] - at[0][1], at[1][2] - at[0][2]}, body + 13);
      const auto write = [&](const L& share, const L& distance, const Num<T, 0>* normal, const L* place) {
        const int64_t to = family++ * all + i;
        store(out[0] + to, share, count), store(out[1] + to, distance, count);
        for (int c = 0; c < 3; ++c) {
          const L* x = body + 3 + c;
          store(out[2 + c] + to, L(x[0] * normal[0].x + x[3] * normal[1].x + x[6] * normal[2].x), count);
          store(out[5 + c] + to, place[c], count);
        }
      };
      for (int e = 0; e < 2; ++e) {
        Num<T, 0> p[3], normal[3];
        for (int c = 0; c < 3; ++c) p[c] = Num<T, 0>(at[e][c]);
        const L distance = probe(shape, grid, line.size, p, normal).x;
        write(L{} + T(e), distance, normal, arm[e]);
      }
      for (int64_t j = 0; j < n.pieces[k]; ++j) {
        const Found<T> found = nearest(line, T(j) / n.pieces[k], T(j + 1) / n.pieces[k]);
        Num<T, 0> result[5];
        end(line, &found, (T(j) + T(0.5)) / n.pieces[k], result);
        L place[3];
        for (int c = 0; c < 3; ++c) place[c] = arm[0][c] + result[0].x * (arm[1][c] - arm[0][c]);
        write(result[0].x, result[1].x, result + 2, place);
      }
    }
  }
}

#define ENTRY(name, T)                                                                                  \
  extern "C" void name##_search(const T* const* edges, const T* const* body, T* const* out, const Sizes* n, \
                                int threads) {                                                          \
    search<T>(edges, body, out, *n, threads);                                                           \
  }                                                                                                     \
  extern "C" void name##_points(const T* const* pos, const T* const* bodies, T* const* out, const AllSizes* n, \
                                int threads) {                                                          \
    points<T>(pos, bodies, out, *n, threads);                                                           \
  }
ENTRY(edge_search_float, float)
ENTRY(edge_search_double, double)
