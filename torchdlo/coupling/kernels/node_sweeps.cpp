// Projected Jacobi sweeps between edges of ropes and nodes of a grid, and their derivative; formulas as in exchange.py.
//
// One scene per thread, sums always in the same order. Arrays of a scene: nodes (N, 3) or (N), in the order x, y, z,
// the last one fastest; vertices (V, 3) or (V). Only pairs that can exchange momentum are kept, edge by edge.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "flush.h"

struct Sizes {
  int64_t scenes, nodes, vertices, sweeps;
  const int64_t *size, *after;  // nodes along each axis; next vertices, -1 where there is no edge
  double spacing, relaxation;
};

template <typename T>
struct V3 {
  T x, y, z;
  V3 operator+(const V3& o) const { return {x + o.x, y + o.y, z + o.z}; }
  V3 operator-(const V3& o) const { return {x - o.x, y - o.y, z - o.z}; }
  V3 operator-() const { return {-x, -y, -z}; }
  V3 operator*(T k) const { return {x * k, y * k, z * k}; }
  void operator+=(const V3& o) { x += o.x, y += o.y, z += o.z; }
  void operator-=(const V3& o) { x -= o.x, y -= o.y, z -= o.z; }
};
template <typename T>
static inline T dot(const V3<T>& a, const V3<T>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <typename T>
static inline V3<T> cross(const V3<T>& a, const V3<T>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
// Length; vectors as short as in physics/linalg/numerics.py count as zero.
template <typename T>
static inline T length(const V3<T>& a) {
  const T squared = dot(a, a), tiny = sizeof(T) == 8 ? T(1e-12) : T(1e-8);
  return squared <= tiny * tiny ? T(0) : std::sqrt(squared);
}

// What a scene is made of, or the derivative by it.
template <typename T>
struct Inputs {
  V3<T>* vel;       // of nodes
  T* mass;          // of nodes
  T* share;         // one number
  const T* corner;  // place of the first node
  V3<T>*pos, *moving;
  T *inverse, *reach;  // of vertices, of edges
  T* friction;         // one number
  Inputs(T* const* from, int64_t b, const Sizes& n)
      : vel((V3<T>*)from[0] + b * n.nodes), mass(from[1] + b * n.nodes), share(from[2] + b), corner(from[3] + 3 * b),
        pos((V3<T>*)from[4] + b * n.vertices), moving((V3<T>*)from[5] + b * n.vertices),
        inverse(from[6] + b * n.vertices), reach(from[7] + b * n.vertices), friction(from[8] + b) {}
};

template <typename T>
struct Scene {
  typedef V3<T> R;
  static constexpr T TINIEST = std::numeric_limits<T>::min();
  struct Pair {
    int node;              // among those that are touched
    T raw, s;              // nearest point on the edge, before and after it is kept between the ends
    R away, arm, normal;   // from the first end to the node, from the nearest point, its direction
    T distance, inverse;   // of the node
    T lever, normal_soft, slip_soft;
    R around;
  };
  struct Edge {
    int first, second, begin, end;  // vertices, and pairs
    R along, direction;
    T squared, length;
  };
  struct Found {  // by a sweep
    T normal;
    R rub;
  };
  struct Step {  // what a sweep starts from, and what it finds
    std::vector<R> given, vel;
    std::vector<Found> found;
  };
  struct Adjoint {  // derivative by a pair
    T s, inverse, normal_soft, slip_soft, normal;
    R arm, direction, around, rub;
  };
  const Sizes n;
  std::vector<int> local;  // of every node, -1 if not touched
  std::vector<T> least;    // distance of a touched node from its nearest edge
  std::vector<int> nodes, each;
  std::vector<Edge> edges;
  std::vector<Pair> pairs;
  std::vector<T> load, sliding;
  std::vector<Step> steps;
  std::vector<R> given, vel;

  explicit Scene(const Sizes& sizes) : n(sizes), local(sizes.nodes, -1), steps(sizes.sweeps) {}

  void find(const Inputs<T>& in) {
    const T h = T(n.spacing), infinite = std::numeric_limits<T>::infinity();
    for (int node : nodes) local[node] = -1;
    nodes.clear(), edges.clear(), pairs.clear(), least.clear();
    for (int v = 0; v < n.vertices; ++v) {
      if (n.after[v] < 0) continue;
      const R a = in.pos[v], b = in.pos[n.after[v]], e = b - a;
      Edge edge{v, int(n.after[v]), int(pairs.size()), 0, e, e * (1 / std::max(length(e), TINIEST)), dot(e, e), length(e)};
      int from[3], to[3];
      bool near = true;
      for (int k = 0; k < 3; ++k) {
        const T p = (&a.x)[k] - in.corner[k], q = (&b.x)[k] - in.corner[k], r = in.reach[v];
        const T low = std::max(T(0), std::ceil((std::min(p, q) - r) / h));
        const T high = std::min(T(n.size[k] - 1), std::floor((std::max(p, q) + r) / h));
        near = near && low <= high;  // not so for what is not a number
        if (near) from[k] = int(low), to[k] = int(high);
      }
      if (!near) continue;
      const R start = R{in.corner[0], in.corner[1], in.corner[2]} - a;
      for (int i = from[0]; i <= to[0]; ++i)
        for (int j = from[1]; j <= to[1]; ++j)
          for (int k = from[2]; k <= to[2]; ++k) {
            const int node = int((i * n.size[1] + j) * n.size[2] + k);
            if (!(in.mass[node] > 0)) continue;
            Pair p;
            p.away = R{T(i) * h, T(j) * h, T(k) * h} + start;
            p.raw = dot(p.away, e) / std::max(edge.squared, TINIEST);
            p.s = std::min(std::max(p.raw, T(0)), T(1));
            p.arm = p.away - e * p.s;
            p.distance = length(p.arm);
            if (!(p.distance < in.reach[v] && p.distance > 0)) continue;
            if (local[node] < 0) local[node] = int(nodes.size()), nodes.push_back(node), least.push_back(infinite);
            p.node = local[node];
            least[p.node] = std::min(least[p.node], p.distance);
            pairs.push_back(p);
          }
      edge.end = int(pairs.size());
      if (edge.end > edge.begin) edges.push_back(edge);
    }
    keep();
  }

  // Keeps the pairs of a node and its nearest edge, or of edges that are equally near.
  void keep() {
    int count = 0;
    each.assign(nodes.size(), 0);
    for (Edge& e : edges) {
      const int begin = count;
      for (int p = e.begin; p < e.end; ++p)
        if (pairs[p].distance <= T(1 + 1e-6) * least[pairs[p].node]) ++each[pairs[p].node], pairs[count++] = pairs[p];
      e.begin = begin, e.end = count;
    }
    pairs.resize(count);
  }

  void soften(const Inputs<T>& in) {
    load.assign(n.vertices, T(0)), sliding.assign(n.vertices, T(0));
    for (const Edge& e : edges)
      for (int k = e.begin; k < e.end; ++k) {
        Pair& p = pairs[k];
        p.normal = p.arm * (1 / p.distance);
        p.inverse = *in.share / in.mass[nodes[p.node]];
        p.lever = p.distance / std::max(e.length, TINIEST);
        p.around = cross(e.direction, p.arm);
        load[e.first] += 1 - p.s, load[e.second] += p.s;
        sliding[e.first] += 1 - p.s + p.lever, sliding[e.second] += p.s + p.lever;
      }
    for (const Edge& e : edges)
      for (int k = e.begin; k < e.end; ++k) {
        Pair& p = pairs[k];
        const T i = in.inverse[e.first], j = in.inverse[e.second], node = p.inverse * each[p.node];
        p.normal_soft = node + (1 - p.s) * load[e.first] * i + p.s * load[e.second] * j;
        p.slip_soft = node + (1 - p.s + p.lever) * sliding[e.first] * i + (p.s + p.lever) * sliding[e.second] * j;
      }
  }

  // How an edge moves in a sweep: its ends, and its turning.
  struct Motion {
    R first, second, turn;
  };
  Motion motion(const Edge& e, const Inputs<T>& in, const Step& s) const {
    const R a = in.moving[e.first] + s.given[e.first] * in.inverse[e.first];
    const R b = in.moving[e.second] + s.given[e.second] * in.inverse[e.second];
    return {a, b, cross((b - a) * (1 / e.squared), e.along)};
  }
  // What a pair does in a sweep before the edge is kept from spinning.
  struct Contact {
    R apart, raw, slip, trial, rub;
    T along, wanted, normal, size;
    bool slides;
  };
  Contact contact(const Pair& p, const Motion& m, const R& vel, const Found& before, T mu) const {
    Contact c;
    c.apart = vel - (m.first * (1 - p.s) + m.second * p.s);
    c.along = dot(c.apart, p.normal);
    c.wanted = before.normal - T(n.relaxation) * c.along / p.normal_soft;
    c.normal = c.wanted < 0 ? T(0) : c.wanted;  // what is not a number stays so
    c.raw = c.apart + cross(m.turn, p.arm);
    c.slip = c.raw - p.normal * dot(c.raw, p.normal);
    c.trial = before.rub - c.slip * (T(n.relaxation) / p.slip_soft);
    c.size = length(c.trial);
    c.slides = c.size > mu * c.normal;
    c.rub = c.slides ? c.trial * (mu * c.normal / c.size) : c.trial;
    return c;
  }
  Found before(int s, int k) const { return s ? steps[s - 1].found[k] : Found{}; }

  void forward(const Inputs<T>& in) {
    find(in);
    soften(in);
    given.assign(n.vertices, R{}), vel.resize(nodes.size());
    for (size_t i = 0; i < nodes.size(); ++i) vel[i] = in.vel[nodes[i]];
    for (int s = 0; s < n.sweeps; ++s) sweep(s, in);
  }
  void sweep(int s, const Inputs<T>& in) {
    Step& now = steps[s];
    now.given = given, now.vel = vel, now.found.resize(pairs.size());
    given.assign(n.vertices, R{});
    for (size_t i = 0; i < nodes.size(); ++i) vel[i] = in.vel[nodes[i]];
    for (const Edge& e : edges) {
      const Motion m = motion(e, in, now);
      T hold = 0, spin = 0;
      for (int k = e.begin; k < e.end; ++k) {
        const Pair& p = pairs[k];
        const Contact c = contact(p, m, now.vel[p.node], before(s, k), *in.friction);
        now.found[k] = {c.normal, c.rub};
        hold += c.normal * dot(p.around, p.around), spin += dot(c.rub, p.around);
      }
      R whole{}, second{}, couple{};
      for (int k = e.begin; k < e.end; ++k) {
        const Pair& p = pairs[k];
        Found& f = now.found[k];
        f.rub = hold > 0 ? f.rub - p.around * (f.normal * (spin / hold)) : R{};
        const R impulse = p.normal * f.normal + f.rub;
        vel[p.node] += impulse * p.inverse;
        whole += impulse, second += impulse * p.s, couple -= cross(p.arm, impulse);
      }
      const R across = cross(couple, e.along) * (1 / std::max(e.squared, TINIEST));
      given[e.first] += second - whole - across, given[e.second] += across - second;
    }
  }

  // Goes backwards: `by` is the derivative by what is given to vertices; that by the velocities of nodes is in `to`.
  void backward(const Inputs<T>& in, std::vector<R>& by, Inputs<T>& to) {
    std::vector<Adjoint> d(pairs.size(), Adjoint{});
    std::vector<R> along(edges.size(), R{}), after(nodes.size());
    for (size_t i = 0; i < nodes.size(); ++i) after[i] = to.vel[nodes[i]];
    for (int s = n.sweeps; s--;) back(s, in, by, after, d, along, to);
    for (size_t i = 0; i < nodes.size(); ++i) to.vel[nodes[i]] += after[i];
    harden(in, d, along, to);
    place(in, d, along, to);
  }
  void back(int s, const Inputs<T>& in, std::vector<R>& by, std::vector<R>& felt, std::vector<Adjoint>& d,
            std::vector<R>& along, Inputs<T>& to) {
    const Step& now = steps[s];
    std::vector<R> moved(n.vertices, R{}), seen(nodes.size(), R{});
    const T mu = *in.friction, omega = T(n.relaxation);
    // All but the first sweep start from velocities that `felt` stands for as a whole.
    for (size_t i = 0; i < nodes.size() && s + 1 < n.sweeps; ++i) to.vel[nodes[i]] += felt[i];
    for (size_t q = 0; q < edges.size(); ++q) {
      const Edge& e = edges[q];
      const Motion m = motion(e, in, now);
      const R second = by[e.first] - by[e.second], whole = -by[e.first], across = -second;
      const T clamped = 1 / std::max(e.squared, TINIEST);
      const R dcouple = cross(e.along, across) * clamped;
      R couple{}, turned{};
      T hold = 0, spin = 0, dspin = 0;
      for (int k = e.begin; k < e.end; ++k) {
        const Pair& p = pairs[k];
        const Found& f = now.found[k];
        const R impulse = p.normal * f.normal + f.rub;
        couple -= cross(p.arm, impulse);
        const R dimpulse = felt[p.node] * p.inverse + whole + second * p.s - cross(dcouple, p.arm);
        d[k].inverse += dot(impulse, felt[p.node]);
        d[k].s += dot(impulse, second);
        d[k].arm -= cross(impulse, dcouple);
        d[k].normal += dot(dimpulse, p.normal);
        d[k].direction += dimpulse * f.normal;
        d[k].rub += dimpulse;
        const Contact c = contact(p, m, now.vel[p.node], before(s, k), mu);
        hold += c.normal * dot(p.around, p.around), spin += dot(c.rub, p.around);
        dspin -= f.normal * dot(d[k].rub, p.around);
      }
      const R got = cross(couple, e.along) * clamped;
      along[q] += cross(across, couple) * clamped - e.along * (2 * clamped * dot(across, got));
      const T inverse = hold > 0 ? 1 / hold : T(0), rate = spin * inverse, dsum = dspin * inverse;
      for (int k = e.begin; k < e.end; ++k) {
        const Pair& p = pairs[k];
        Adjoint& g = d[k];
        const Contact c = contact(p, m, now.vel[p.node], before(s, k), mu);
        // Out of the spin of the edge about itself.
        R drub{};
        if (hold > 0) {
          drub = g.rub + p.around * dsum;
          g.around += c.rub * dsum - g.rub * (c.normal * rate) - p.around * (2 * c.normal * dsum * rate);
          g.normal -= rate * dot(g.rub, p.around) + dsum * rate * dot(p.around, p.around);
        }
        // Coulomb's cone.
        R dtrial = drub;
        if (c.slides) {
          const R way = c.trial * (1 / c.size);
          const T part = dot(way, drub);
          *to.friction += c.normal * part, g.normal += mu * part;
          dtrial = (drub - way * part) * (mu * c.normal / c.size);
        }
        g.rub = dtrial;
        const T pressed = c.wanted >= 0 ? g.normal : T(0);
        g.normal = pressed;
        // Across.
        const R dslip = dtrial * (-omega / p.slip_soft);
        g.slip_soft += omega * dot(c.slip, dtrial) / (p.slip_soft * p.slip_soft);
        const T inward = dot(p.normal, dslip);
        const R draw = dslip - p.normal * inward;
        g.direction -= dslip * dot(c.raw, p.normal) + c.raw * inward;
        g.arm += cross(draw, m.turn);
        turned += cross(p.arm, draw);
        // Along.
        const T dalong = -omega / p.normal_soft * pressed;
        g.normal_soft += omega * c.along / (p.normal_soft * p.normal_soft) * pressed;
        g.direction += c.apart * dalong;
        const R dapart = draw + p.normal * dalong;
        seen[p.node] += dapart;
        g.s -= dot(dapart, m.second - m.first);
        moved[e.first] -= dapart * (1 - p.s), moved[e.second] -= dapart * p.s;
      }
      const T one = 1 / e.squared;
      const R dmove = cross(e.along, turned) * one;
      along[q] += cross(turned, m.second - m.first) * one - e.along * (2 * one * dot(turned, m.turn));
      moved[e.first] -= dmove, moved[e.second] += dmove;
    }
    for (int v = 0; v < n.vertices; ++v) {
      to.moving[v] += moved[v], to.inverse[v] += dot(moved[v], now.given[v]);
      by[v] = moved[v] * in.inverse[v];
    }
    felt.swap(seen);
  }
  // The derivative of softness.
  void harden(const Inputs<T>& in, std::vector<Adjoint>& d, std::vector<R>& along, Inputs<T>& to) const {
    std::vector<T> dload(n.vertices, T(0)), dsliding(n.vertices, T(0));
    for (const Edge& e : edges)
      for (int k = e.begin; k < e.end; ++k) {
        const T a = d[k].normal_soft, b = d[k].slip_soft, s = pairs[k].s, lever = pairs[k].lever;
        dload[e.first] += (1 - s) * a, dload[e.second] += s * a;
        dsliding[e.first] += (1 - s + lever) * b, dsliding[e.second] += (s + lever) * b;
      }
    for (int v = 0; v < n.vertices; ++v) to.inverse[v] += load[v] * dload[v] + sliding[v] * dsliding[v];
    for (size_t q = 0; q < edges.size(); ++q) {
      const Edge& e = edges[q];
      const T i = in.inverse[e.first], j = in.inverse[e.second];
      for (int k = e.begin; k < e.end; ++k) {
        const Pair& p = pairs[k];
        Adjoint& g = d[k];
        const T a = g.normal_soft, b = g.slip_soft;
        const T one = b * sliding[e.first] + dsliding[e.first], two = b * sliding[e.second] + dsliding[e.second];
        g.inverse += each[p.node] * (a + b);
        g.s += j * (a * load[e.second] + dload[e.second] + two) - i * (a * load[e.first] + dload[e.first] + one);
        const T dlever = i * one + j * two;
        g.arm += p.normal * (dlever / std::max(e.length, TINIEST));
        if (e.length > 0) along[q] -= e.direction * (dlever * p.lever / e.length);
      }
    }
  }
  // The derivative of where pairs are.
  void place(const Inputs<T>& in, const std::vector<Adjoint>& d, const std::vector<R>& by, Inputs<T>& to) const {
    for (size_t q = 0; q < edges.size(); ++q) {
      const Edge& e = edges[q];
      R along = by[q], away{}, directed{};
      for (int k = e.begin; k < e.end; ++k) {
        const Pair& p = pairs[k];
        const Adjoint& g = d[k];
        directed += cross(p.arm, g.around);
        R arm = g.arm + cross(g.around, e.direction);
        arm += (g.direction - p.normal * dot(p.normal, g.direction)) * (1 / p.distance);
        along -= arm * p.s;
        R off = arm;
        if (p.raw >= 0 && p.raw <= 1) {
          const T raw = (g.s - dot(arm, e.along)) / std::max(e.squared, TINIEST);
          off += e.along * raw, along += (p.away - e.along * (2 * p.raw)) * raw;
        }
        away += off;
        const T mass = in.mass[nodes[p.node]];
        *to.share += g.inverse / mass, to.mass[nodes[p.node]] -= g.inverse * p.inverse / mass;
      }
      if (e.length > 0) along += (directed - e.direction * dot(e.direction, directed)) * (1 / e.length);
      to.pos[e.first] -= away + along, to.pos[e.second] += along;
    }
  }
};

#define SCENES _Pragma("omp for") for (int64_t b = 0; b < n.scenes; ++b)

template <typename T>
static void sweep(T* const* from, V3<T>* given, V3<T>* vel, const Sizes& n, int threads) {
#pragma omp parallel num_threads(threads)
  {
    const FlushTiny flush;
    Scene<T> scene(n);
    SCENES {
      const Inputs<T> in(from, b, n);
      scene.forward(in);
      std::copy(scene.given.begin(), scene.given.end(), given + b * n.vertices);
      std::copy(in.vel, in.vel + n.nodes, vel + b * n.nodes);
      for (size_t i = 0; i < scene.nodes.size(); ++i) vel[b * n.nodes + scene.nodes[i]] = scene.vel[i];
    }
  }
}

// The derivatives that are found are zero at first, but for that by the velocities of nodes: what is given for them.
template <typename T>
static void back(T* const* from, const V3<T>* by, T* const* out, const Sizes& n, int threads) {
#pragma omp parallel num_threads(threads)
  {
    const FlushTiny flush;
    Scene<T> scene(n);
    std::vector<V3<T>> given;
    SCENES {
      const Inputs<T> in(from, b, n);
      Inputs<T> to(out, b, n);
      scene.forward(in);
      given.assign(by + b * n.vertices, by + (b + 1) * n.vertices);
      scene.backward(in, given, to);
    }
  }
}

#define ENTRY(name, T)                                                                                        \
  extern "C" void name##_sweep(T* const* in, T* given, T* vel, const Sizes* n, int threads) {                 \
    sweep<T>(in, (V3<T>*)given, (V3<T>*)vel, *n, threads);                                                    \
  }                                                                                                           \
  extern "C" void name##_back(T* const* in, const T* by, T* const* out, const Sizes* n, int threads) {        \
    back<T>(in, (const V3<T>*)by, out, *n, threads);                                                          \
  }
ENTRY(node_sweeps_float, float)
ENTRY(node_sweeps_double, double)
