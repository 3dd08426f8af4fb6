// What rod_near.cpp does on a GPU: a warp tries all pairs of edges of a scene, its lanes the partners of one edge.
#pragma once

template <typename T>
struct Scene {
  typedef Num<T, 0> P;
  typedef Three<T, 0> V;
  const Sizes n;
  const int size;
  List<T> pos, middle, wide, radius, length, start, whole;
  List<int> after, rod, edge;

  Scene(const Sizes& n, Memory& memory) : n(n), size(int(n.vertices)) {
    memory.common(pos, 3 * size), memory.common(middle, 3 * size), memory.common(wide, size);
    memory.common(radius, size), memory.common(length, size), memory.common(start, size), memory.common(whole, n.rods);
    memory.common(after, size), memory.common(rod, size), memory.common(edge, size);
  }
  void number() {
    int from = 0;
    for (int k = 0; k < n.rods; ++k) {
      const int count = int(n.counts[k]);
      EVERY(i, count) {
        const bool last = i + 1 == count;
        after[from + i] = last ? from : from + i + 1, rod[from + i] = k, edge[from + i] = !last || n.closed[k];
      }
      from += count;
    }
    meet();
  }

  // The square of how far the fastest goes beside `mean`; what is not a number stays so.
  static T further(T a, T b) { return b <= a || a != a ? a : b; }
  T most(const T* const* x, const T* const* from, int64_t count, T scale, const T* mean, int64_t b) const {
    T found = 0;
    EVERY(v, count) {
      T squared = 0;
      for (int k = 0; k < 3; ++k) {
        const int64_t i = v * n.scenes + b;
        const T d = (x[k][i] - (from ? from[k][i] : T(0))) * scale - mean[k];
        squared += d * d;
      }
      found = further(found, squared);
    }
    return everyones(found, [](T a, T b) { return further(a, b); });
  }
  void centre(const T* const* x, const T* const* from, int64_t b, T* mean) const {
    for (int k = 0; k < 3; ++k) {
      T sum = 0;
      EVERY(v, size) sum += x[k][v * n.scenes + b] - (from ? from[k][v * n.scenes + b] : T(0));
      mean[k] = total(sum) / T(size);
    }
  }
  T foresee(const T* const* vel, const T* const* carried, const T* thick, int64_t b) const {
    T mean[3];
    centre(vel, nullptr, b, mean);
    T fast = further(most(vel, nullptr, size, T(1), mean, b), most(carried, nullptr, n.held, T(1 / n.dt), mean, b));
    T sudden = T(n.dt) * (n.burst < 0 ? T(1) : T(n.burst));
    if (n.burst < 0) {
      EVERY(v, size) {
        const T half = T(0.5) * thick[v * n.scenes + b];
        if (half < sudden) sudden = half;
      }
      sudden = everyones(sudden, [](T a, T b) { return b < a ? b : a; });
    }
    return T(n.dt) * T(1.5) * T(std::sqrt(fast)) + sudden;
  }

  void prepare(const T* const* rods, T reach, int64_t b) {
    EVERY(v, size) {
      for (int k = 0; k < 3; ++k) pos[k * size + v] = rods[k][v * n.scenes + b];
      radius[v] = rods[6][v * n.scenes + b], length[v] = rods[7][v * n.scenes + b];
    }
    meet();
    EVERY(v, size) {
      T squared = 0;
      for (int k = 0; k < 3; ++k) {
        const T one = pos[k * size + v], two = pos[k * size + after[v]];
        squared += (two - one) * (two - one), middle[k * size + v] = T(0.5) * (one + two);
      }
      wide[v] = T(0.5) * T(std::sqrt(squared)) + radius[v] + reach;
    }
    if (lane() == 0) {
      T sum = 0;
      for (int k = 0; k < n.rods; ++k) whole[k] = 0;
      for (int v = 0; v < size; ++v) {
        start[v] = sum;
        if (edge[v]) sum += length[v], whole[rod[v]] += length[v];
      }
    }
    meet();
  }
  // Whether edges are of different rods, or far enough along one for it to come back to itself.
  bool separate(int i, int j) const {
    if (rod[i] != rod[j]) return true;
    const int64_t steps = j - i, count = n.counts[rod[i]];
    const bool closed = n.closed[rod[i]];
    const T between = start[j] - start[i] - length[i], back = whole[rod[i]] - between - length[i] - length[j];
    const T arc = closed && back < between ? back : between, thick = radius[i] + radius[j];
    return (closed && count - steps < steps ? count - steps : steps) >= n.apart && arc >= T(1.5707963267948966) * thick;
  }
  bool near(int i, int j, T reach) const {
    T squared = 0;
    const T limit = wide[i] + wide[j];
    for (int k = 0; k < 3; ++k) {
      const T d = middle[k * size + i] - middle[k * size + j];
      squared += d * d;
    }
    if (!(squared <= limit * limit) || !separate(i, j)) return false;
    const int corner[4] = {i, after[i], j, after[j]};
    V p[4];
    for (int c = 0; c < 4; ++c)
      p[c] = {P(pos[corner[c]]), P(pos[size + corner[c]]), P(pos[2 * size + corner[c]])};
    P s, t;
    closest(p, s, t);
    V way;
    const P apart = measured(p[0] + (p[1] - p[0]) * s - p[2] - (p[3] - p[2]) * t, way);
    return apart.x[0] <= radius[i] + radius[j] + 2 * reach;
  }
  void write(int i, int j, int64_t k, bool real, int64_t* at, T* out, int64_t b) const {
    const int corner[4] = {i, after[i], j, after[j]};
    for (int c = 0; c < 4; ++c) at[(c * n.room + k) * n.scenes + b] = corner[c] * n.scenes + b;
    out[k * n.scenes + b] = T(real);
  }
  void find(T reach, int64_t* at, T* real, T* lost, int64_t b) const {
    int64_t found = 0;
    int first = size;
    for (int i = 0; i < size; ++i) {
      if (!edge[i]) continue;
      if (first == size) first = i;
      for (int from = i + 1; from < size; from += WARP) {
        const int j = from + lane();
        int all;
        const bool yes = j < size && edge[j] && near(i, j, reach);
        const int64_t place = found + ahead(yes, all);
        if (yes && place < n.room) write(i, j, place, true, at, real, b);
        found += all;
      }
    }
    const int64_t some = found < n.room ? found : n.room;
    EVERY(k, n.room - some) write(first, first, some + k, false, at, real, b);
    if (lane() == 0) lost[b] = T(found - some);
  }
};

// Arrays: positions, velocities, radius and rest length of vertices, carried; places, real, lost, reach.
template <typename T>
static void look(const Sizes& n, const Fields& p, const Room& room) {
  Memory memory = room.memory();
  Scene<T> scene(n, memory);
  scene.number();
  for (int64_t b = first_scene(); b < n.scenes; b += scene_step()) {
    const T* const* rods = p.from<const T>(0);
    const T reach = scene.foresee(rods + 3, p.from<const T>(8), rods[6], b);
    scene.prepare(rods, reach, b);
    scene.find(reach, (int64_t*)p.at[11], (T*)p.at[12], (T*)p.at[13], b);
    if (lane() == 0) ((T*)p.at[14])[b] = reach;
    meet();
  }
}
// Arrays: positions, those before, reach; by how far vertices went beyond it, beside the mean of all.
template <typename T>
static void outrun(const Sizes& n, const Fields& p, const Room& room) {
  Memory memory = room.memory();
  const Scene<T> scene(n, memory);
  for (int64_t b = first_scene(); b < n.scenes; b += scene_step()) {
    T mean[3];
    scene.centre(p.from<const T>(0), p.from<const T>(3), b, mean);
    const T most = scene.most(p.from<const T>(0), p.from<const T>(3), n.vertices, T(1), mean, b);
    const T over = T(std::sqrt(most)) - ((const T*)p.at[6])[b];
    if (lane() == 0) ((T*)p.at[7])[b] = over < T(0) ? T(0) : over;
  }
}
template <typename T>
static void count(const Sizes& n, const Fields& p) {
  Memory memory{};
  const Scene<T> scene(n, memory);
  memory.report(p);
}
KERNEL(rod_near_look, Sizes) { look<NUMBER>(n, p, room); }
KERNEL(rod_near_outrun, Sizes) { outrun<NUMBER>(n, p, room); }
KERNEL(rod_near_look_memory, Sizes) { count<NUMBER>(n, p); }
KERNEL(rod_near_outrun_memory, Sizes) { count<NUMBER>(n, p); }
