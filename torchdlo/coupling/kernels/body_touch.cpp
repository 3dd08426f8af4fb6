// Points of edges that may touch bodies in implicit steps, and their derivative; formulas and names as in `engage` of
// rod_body_effect.py and in segment_distance.py.
//
// Numbers come as (V, B) or (K, B) for each field of `Around`, and go as (B, F, V, 12), the fields of `Result`. Edges of
// all scenes stand side by side. The derivative is worked out for points that have one only.
#include "edge_points.h"
#include "flush.h"

#include <algorithm>

struct Sizes {
  int64_t vertices, scenes, bodies, families, corners, friction;
  const int64_t *shape, *pieces, *after, *cells;
  const void* grids;
  double recovery, slowest, fastest, thick, dt;
  template <typename T>
  Grid<T> grid(int64_t body) const {
    return {(const T*)grids + body * corners, cells + 3 * body};
  }
};

// An edge, its two ends, and a body.
template <typename T, int N>
struct Around {
  typedef Num<T, N> S;
  typedef Three<T, N> V;
  V tangent;
  S lever, radius;
  V pos[2], vel[2], change[2];
  V place, axes[3];
  S offset, numbers[4];
  V speed, spin, shift, turn;
  S mu_s, mu_k, restitution;

  V local(const V& a) const { return {dot(axes[0], a), dot(axes[1], a), dot(axes[2], a)}; }
};
constexpr int EDGE = 5, VERTEX = 9, ENDS = 18, BODY = 32, ALL = EDGE + ENDS + BODY;

template <typename T, int N>
struct Result {
  Num<T, N> share;
  Three<T, N> normal;
  Num<T, N> wanted;
  Three<T, N> given;
  Num<T, N> mu;
  Three<T, N> arm;
};
constexpr int FIELDS = 12;

template <typename T, int N>
static Three<T, 0> plain(const Three<T, N>& a) {
  return {Num<T, 0>(a.x.x), Num<T, 0>(a.y.x), Num<T, 0>(a.z.x)};
}

// By how much a point parts from its body where both move.
template <typename T, int N>
static Three<T, N> parted(const Three<T, N>* ends, const Three<T, N>& shift, const Three<T, N>& turn,
                          const Num<T, N>& share, const Three<T, N>& arm) {
  return ends[0] + (ends[1] - ends[0]) * share - shift - cross(turn, arm);
}

template <typename T, int N>
static Line<T, N> line_of(const Around<T, N>& x, int64_t body, const Sizes& n) {
  Three<T, N> start = x.local(x.pos[0] - x.place);
  start.x = start.x + x.offset;
  return Line<T, N>(int(n.shape[body]), n.grid<T>(body), start, x.local(x.pos[1] - x.pos[0]), x.numbers);
}

template <typename T, int N>
static Result<T, N> result(const Around<T, N>& x, const Line<T, N>& line, const Found<T>* found, T at,
                           const Lanes<T>& real, const Sizes& n) {
  typedef Num<T, N> S;
  typedef Three<T, N> V;
  Result<T, N> to;
  S near[5];
  end<T, N>(line, found, at, near);
  const V arm = x.pos[0] - x.place, way = x.pos[1] - x.pos[0];
  to.share = near[0];
  to.normal = x.axes[0] * near[2] + x.axes[1] * near[3] + x.axes[2] * near[4];
  to.arm = arm + way * to.share;

  const V across = x.turn - x.tangent * dot(x.tangent, x.turn);
  to.given = cross(across * x.radius, to.normal) - x.shift - cross(x.turn, to.arm);

  const S over = x.radius - near[1], zero(T(0)), most(T(n.fastest * n.dt));
  const S deep = positive(over - S(T(0.1)) * x.radius) * S(T(1 - n.recovery));
  const S simple = select(over.x < T(0), over, S(T(n.recovery)) * over + deep), asked = positive(simple);
  to.wanted = select(simple.x > T(0), asked * most / (asked + most), simple);

  const Lanes<T> slowest = root<T>(x.radius.x * T(n.slowest * n.slowest / n.thick));
  const Three<T, 0> normal = plain(to.normal), place = plain(to.arm), tangent = plain(x.tangent);
  const Num<T, 0> share(to.share.x);
  if (any(x.restitution.x > T(0))) {
    const Three<T, 0> change[2] = {plain(x.change[0]), plain(x.change[1])};
    const Three<T, 0> ahead = parted(change, plain(x.shift), plain(x.turn), share, place);
    const auto pressed = (real > T(0)) & (dot(normal, ahead).x < to.wanted.x);
    const S approach = -dot(to.normal, parted(x.vel, x.speed, x.spin, to.share, to.arm));
    const S back = x.restitution * approach * S(T(n.dt));
    const auto hits = pressed & (approach.x > slowest) & (back.x > T(0)) & (back.x > to.wanted.x);
    to.wanted = select(hits, back, to.wanted);
  }
  to.mu = zero;
  if (!n.friction) return to;
  const Three<T, 0> vel[2] = {plain(x.vel[0]), plain(x.vel[1])}, spin = plain(x.spin);
  const Three<T, 0> beside = spin - tangent * dot(tangent, spin);
  const Three<T, 0> swing = cross(tangent, vel[1] - vel[0]) * Num<T, 0>(x.lever.x) - beside * Num<T, 0>(x.radius.x);
  Three<T, 0> slip = parted(vel, plain(x.speed), spin, share, place) - cross(swing, normal);
  slip -= normal * dot(normal, slip);
  const auto slides = root<T>(dot(slip, slip).x) > slowest;
  to.mu = select(slides, x.mu_k, x.mu_s);
  return to;
}

// Where edges and their ends and bodies stand that are looked at side by side.
template <typename T>
struct Lookup {
  static constexpr int W = WIDTH<T>;
  int64_t here[W], next[W], scene[W], count;
  const Sizes& n;
  explicit Lookup(const Sizes& n) : n(n) {}
  void set(int lane, int64_t vertex, int64_t b) {
    here[lane] = vertex * n.scenes + b, next[lane] = n.after[vertex] * n.scenes + b, scene[lane] = b;
  }
  static Lanes<T> pick(const T* from, const int64_t* at) {
    Lanes<T> x;
    if (at[W - 1] - at[0] == W - 1) {
      bool row = true;
      for (int l = 1; l < W; ++l) row = row && at[l] - at[0] == l;
      if (row) {
        std::memcpy(&x, from + at[0], sizeof(x));
        return x;
      }
    }
    T found[W];
    for (int l = 0; l < W; ++l) found[l] = from[at[l]];
    std::memcpy(&x, found, sizeof(x));
    return x;
  }
  void edge(const T* const* edges, const T* const* vertices, Around<T, 0>& x) const {
    Num<T, 0>* to = (Num<T, 0>*)&x;
    for (int k = 0; k < EDGE; ++k) to[k].x = pick(edges[k], here);
    for (int k = 0; k < VERTEX; ++k) {
      Num<T, 0>* at = to + EDGE + 6 * (k / 3) + k % 3;
      at[0].x = pick(vertices[k], here), at[3].x = pick(vertices[k], next);
    }
  }
  void body(const T* const* bodies, int64_t k, Around<T, 0>& x) const {
    Num<T, 0>* to = (Num<T, 0>*)&x + EDGE + ENDS;
    for (int f = 0; f < BODY; ++f) to[f].x = pick(bodies[f] + k * n.scenes, scene);
  }
};

template <typename T>
static T middle(const Sizes& n, int64_t body, int64_t piece) {
  return piece < 0 ? T(piece + 2) : T((piece + 0.5) / n.pieces[body]);
}
template <typename T>
static Found<T> search(const Line<T, 0>& line, const Sizes& n, int64_t body, int64_t piece) {
  return nearest<T>(line, T(piece) / n.pieces[body], T(piece + 1) / n.pieces[body]);
}

template <typename T>
static void find(const T* const* edges, const T* const* vertices, const T* const* bodies, T* out, const Sizes& n,
                 int threads) {
  constexpr int W = WIDTH<T>;
  const int64_t all = n.vertices * n.scenes;
  _Pragma("omp parallel for num_threads(threads) if (threads > 1)")
  for (int64_t i = 0; i < all; i += W) {
    const FlushTiny flush;
    Lookup<T> at(n);
    const int64_t count = std::min<int64_t>(W, all - i);
    for (int l = 0; l < W; ++l) {
      const int64_t k = l < count ? i + l : i;
      at.set(l, k / n.scenes, k % n.scenes);
    }
    Around<T, 0> x;
    at.edge(edges, vertices, x);
    const Lanes<T> real = at.pick(edges[EDGE], at.here);
    int64_t family = 0;
    for (int64_t k = 0; k < n.bodies; ++k) {
      at.body(bodies, k, x);
      const Line<T, 0> line = line_of(x, k, n);
      for (int64_t j = -2; j < n.pieces[k]; ++j, ++family) {
        Found<T> found;
        if (j >= 0) found = search(line, n, k, j);
        const Result<T, 0> r = result<T, 0>(x, line, j < 0 ? nullptr : &found, middle<T>(n, k, j), real, n);
        for (int64_t l = 0; l < count; ++l) {
          const int64_t vertex = (i + l) / n.scenes;
          T* to = out + ((at.scene[l] * n.families + family) * n.vertices + vertex) * FIELDS;
          for (int f = 0; f < FIELDS; ++f) to[f] = ((const Num<T, 0>*)&r)[f].x[l];
        }
      }
    }
  }
}

// Adds the derivative of the same point of some edges.
template <typename T>
static void back(const Lookup<T>& at, int64_t k, int64_t j, const Lanes<T>* by, const T* const* edges,
                 const T* const* vertices, const T* const* bodies, T* const* de, T* const* dv, T* const* dk) {
  typedef Num<T, TAPED> R;
  const Sizes& n = at.n;
  Around<T, 0> given;
  at.edge(edges, vertices, given), at.body(bodies, k, given);
  const Lanes<T> real = at.pick(edges[EDGE], at.here);
  Found<T> found;
  if (j >= 0) found = search(line_of(given, k, n), n, k, j);
  Tape<T>& tape = Tape<T>::on();
  tape.nodes.clear();
  Around<T, TAPED> x;
  for (int i = 0; i < ALL; ++i) ((R*)&x)[i] = R::variable(((const Num<T, 0>*)&given)[i].x, 0);
  const Line<T, TAPED> line = line_of(x, k, n);
  const Result<T, TAPED> r = result<T, TAPED>(x, line, j < 0 ? nullptr : &found, middle<T>(n, k, j), real, n);
  tape.begin();
  for (int f = 0; f < FIELDS; ++f) ((const R*)&r)[f].give(by[f]);
  tape.back(int(tape.nodes.size()), 0);
  const R* from = (const R*)&x;
  const auto add = [&](T* to, const int64_t* places, const Lanes<T>& more) {
    for (int64_t l = 0; l < at.count; ++l) to[places[l]] += more[l];
  };
  for (int f = 0; f < EDGE; ++f) add(de[f], at.here, from[f].by());
  for (int f = 0; f < VERTEX; ++f) {
    const R* one = from + EDGE + 6 * (f / 3) + f % 3;
    add(dv[f], at.here, one[0].by()), add(dv[f], at.next, one[3].by());
  }
  for (int f = 0; f < BODY; ++f) add(dk[f] + k * n.scenes, at.scene, from[EDGE + ENDS + f].by());
}

template <typename T>
static void derive(const T* const* edges, const T* const* vertices, const T* const* bodies, const T* by, T* const* de,
                   T* const* dv, T* const* dk, const Sizes& n, int threads) {
  constexpr int W = WIDTH<T>;
  // Neighbouring scenes share lines of memory.
  _Pragma("omp parallel for num_threads(threads) if (threads > 1)")
  for (int64_t first = 0; first < n.scenes; first += 16) {
    const FlushTiny flush;
    const int64_t last = std::min(first + 16, n.scenes);
    int64_t family = 0;
    for (int64_t k = 0; k < n.bodies; ++k)
      for (int64_t j = -2; j < n.pieces[k]; ++j, ++family) {
        Lookup<T> at(n);
        Lanes<T> wanted[FIELDS];
        at.count = 0;
        const auto flush_lanes = [&]() {
          if (!at.count) return;
          // Lanes that stay free do what the first does, and nothing is made of it.
          for (int64_t l = at.count; l < W; ++l) at.here[l] = at.here[0], at.next[l] = at.next[0], at.scene[l] = at.scene[0];
          back(at, k, j, wanted, edges, vertices, bodies, de, dv, dk);
          at.count = 0;
        };
        for (int64_t b = first; b < last; ++b)
          for (int64_t v = 0; v < n.vertices; ++v) {
            const T* mine = by + ((b * n.families + family) * n.vertices + v) * FIELDS;
            bool none = true;
            for (int f = 0; f < FIELDS; ++f) none = none && mine[f] == T(0);
            if (none) continue;
            if (!at.count)
              for (int f = 0; f < FIELDS; ++f) wanted[f] = Lanes<T>{};
            for (int f = 0; f < FIELDS; ++f) wanted[f][at.count] = mine[f];
            at.set(int(at.count++), v, b);
            if (at.count == W) flush_lanes();
          }
        flush_lanes();
      }
  }
}

#define ENTRY(name, T)                                                                                           \
  extern "C" void name##_find(const T* const* e, const T* const* v, const T* const* k, T* out, const Sizes* n,   \
                              int threads) {                                                                     \
    find<T>(e, v, k, out, *n, threads);                                                                          \
  }                                                                                                              \
  extern "C" void name##_back(const T* const* e, const T* const* v, const T* const* k, const T* by, T* const* de, \
                              T* const* dv, T* const* dk, const Sizes* n, int threads) {                         \
    derive<T>(e, v, k, by, de, dv, dk, *n, threads);                                                             \
  }
ENTRY(body_touch_float, float)
ENTRY(body_touch_double, double)
