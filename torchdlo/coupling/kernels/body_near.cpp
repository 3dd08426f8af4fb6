// Nodes of the grid that are near rigid bodies; see body_near.py. One scene per thread, nodes of a scene side by side.
//
// mass (scenes, nodes), origin (scenes, 3), solids (scenes, bodies, 17), chosen (scenes, room), lost (scenes).
#include "edge_points.h"
#include "flush.h"

#include <algorithm>
#include <limits>
#include <utility>

struct Sizes {
  int64_t scenes, bodies, room, corners;  // numbers per grid of a mesh
  const int64_t *size, *shape, *cells;    // nodes along each axis; per body; three per body
  const void* grids;
  double first[3], spacing, reach;  // of the whole grid
};

// A body as a row of numbers: place, axes, offset of its shape, and the shape's size.
template <typename T>
struct Body {
  const T* at;
  Num<T, 0> size[4];
  explicit Body(const T* row) : at(row) {
    for (int k = 0; k < 4; ++k) size[k] = Num<T, 0>(row[13 + k]);
  }
  Lanes<T> distance(int shape, const Grid<T>& grid, const Lanes<T>* point) const {
    const Lanes<T> x = point[0] - at[0], y = point[1] - at[1], z = point[2] - at[2];
    Num<T, 0> local[3], normal[3];
    for (int k = 0; k < 3; ++k) local[k] = Num<T, 0>(at[3 + 3 * k] * x + at[4 + 3 * k] * y + at[5 + 3 * k] * z);
    local[0].x += at[12];
    return probe(shape, grid, size, local, normal).x;
  }
};

template <typename T>
static void scene(const T* mass, const T* origin, const T* solids, int64_t* chosen, int64_t* lost, const Sizes& n) {
  const int64_t count = n.size[0] * n.size[1] * n.size[2];
  std::vector<Body<T>> bodies;
  for (int64_t k = 0; k < n.bodies; ++k) bodies.emplace_back(solids + 17 * k);
  std::vector<std::pair<T, int64_t>> near;
  int64_t waiting[WIDTH<T>], have = 0;
  Lanes<T> point[3] = {};

  const auto look = [&] {
    Lanes<T> off = Lanes<T>{} + std::numeric_limits<T>::infinity();
    for (int64_t k = 0; k < n.bodies; ++k) {
      const Grid<T> grid = {(const T*)n.grids + k * n.corners, n.cells + 3 * k};
      const Lanes<T> d = bodies[k].distance(int(n.shape[k]), grid, point);
      off = d < off ? d : off;
    }
    for (int64_t i = 0; i < have; ++i)
      if (off[i] < T(n.reach)) near.emplace_back(off[i], waiting[i]);
    have = 0;
  };
  int64_t node = 0;
  for (int64_t i = 0; i < n.size[0]; ++i)
    for (int64_t j = 0; j < n.size[1]; ++j)
      for (int64_t k = 0; k < n.size[2]; ++k, ++node) {
        if (!(mass[node] > 0)) continue;
        const int64_t number[3] = {i, j, k};
        for (int a = 0; a < 3; ++a) point[a][have] = (origin[a] + T(number[a])) * T(n.spacing) + T(n.first[a]);
        waiting[have++] = node;
        if (have == WIDTH<T>) look();
      }
  if (have) look();

  const int64_t found = std::min<int64_t>(near.size(), n.room);
  *lost = int64_t(near.size()) - found;
  if (*lost) std::nth_element(near.begin(), near.begin() + found, near.end());
  // In the order of nodes; room that is left goes to others, which no body reaches.
  std::vector<char> taken(count);
  for (int64_t i = 0; i < found; ++i) chosen[i] = near[i].second, taken[near[i].second] = 1;
  std::sort(chosen, chosen + found);
  for (int64_t i = found, other = 0; i < n.room; ++other)
    if (!taken[other]) chosen[i++] = other;
}

#define ENTRY(T)                                                                                                  \
  extern "C" void body_near_##T##_choose(const T* mass, const T* origin, const T* solids, int64_t* chosen,        \
                                         int64_t* lost, const Sizes* n, int threads) {                            \
    const int64_t count = n->size[0] * n->size[1] * n->size[2];                                                   \
    _Pragma("omp parallel for num_threads(threads)") for (int64_t b = 0; b < n->scenes; ++b)                      \
        if (const FlushTiny flush; true)                                                                          \
            scene<T>(mass + b * count, origin + 3 * b, solids + 17 * b * n->bodies, chosen + b * n->room, lost + b, *n); \
  }
ENTRY(float)
ENTRY(double)
