// Projected Jacobi sweeps for points of ropes on bodies, and their derivative; formulas and names as in rod_body.py.
//
// All arrays have the scenes last: (V, B) or (K, B) for each field of the structs in body_points.h, force on vertices (3),
// force and torque on bodies (6).
//
// A block of scenes is worked on side by side; points that are active in none of them cost next to nothing.
#include "body_points.h"
#include "flush.h"

#include <memory>
#include <vector>

template <typename T>
struct Block : Geometry<T> {
  typedef Geometry<T> G;
  using G::points, G::edges, G::vertices, G::bodies, G::n, G::change, G::motion;
  using G::near, G::edge, G::body, G::apart, G::exert, G::seen, G::tilt;
  typedef Lanes<T> L;
  typedef Vec<T> R;
  struct Step {  // what a sweep starts from, and what it finds
    List<Vec<T>> force;    // on vertices, from the sweep before
    List<Wrench<T>> push;  // on bodies, likewise
    List<Force<T>> found;
    List<int> pressed, rubbing;  // points that are active in some scene
  };
  List<Step> steps;
  List<Vec<T>> force;
  List<Wrench<T>> push;
  List<L> active, load_, many, count, levers;

  explicit Block(const Sizes& n)
      : G(n), steps(n.sweeps), active(points.size()) {
    for (Step& s : steps) s.found.resize(points.size());
  }

  void move(const Step& s) {
    for (int v = 0; v < n.vertices; ++v) change[v] = vertices[v].change + vertices[v].answer.times(s.force[v]);
    for (int k = 0; k < n.bodies; ++k) {
      const Solid<T>& b = bodies[k];
      motion[k] = {b.change + s.push[k].force * b.mobility, b.turn + b.turned(s.push[k].torque)};
    }
  }

  // Sums over active points that all softness is made of; `root` is the turning or the sliding part of a point.
  void gather(const List<int>& list, L Point<T>::*root) {
    const L zero{};
    load_.assign(n.vertices, zero), many.assign(n.vertices, zero);
    count.assign(n.bodies, zero), levers.assign(n.bodies, zero);
    for (int p : list) {
      const L on = active[p], &s = points[p].share;
      const int v = edge(p), k = body(p);
      load_[v] += on * (T(1) - s), load_[n.after[v]] += on * s, many[v] += on;
      count[k] += on, levers[k] += on * (points[p].*root);
    }
  }
  L softness(int p, L Point<T>::*root, bool friction) const {
    const Point<T>& a = points[p];
    const int v = edge(p), w = n.after[v], k = body(p);
    const L i = vertices[v].soft, j = vertices[w].soft, lever = edges[v].lever;
    L sum = (T(1) - a.share) * load_[v] * i + a.share * load_[w] * j;
    sum += bodies[k].mobility * count[k] + (a.*root) * levers[k];
    return friction ? sum + lever * lever * (i + j) * many[v] : sum;
  }
  // Adds the derivative of the softness of all points, given as `by`.
  void soften(const List<int>& list, const List<L>& by, L Point<T>::*root, bool friction, Inputs<T>& to) {
    const L zero{};
    List<L> dload(n.vertices, zero), dlevers(n.bodies, zero);
    for (int p : list) {
      const Point<T>& a = points[p];
      const int v = edge(p), w = n.after[v], k = body(p);
      const L i = vertices[v].soft, j = vertices[w].soft, g = by[p], one = (T(1) - a.share) * g, two = a.share * g;
      to.points[p].share += g * (load_[w] * j - load_[v] * i);
      dload[v] += one * i, dload[w] += two * j;
      to.vertices[v].soft += one * load_[v], to.vertices[w].soft += two * load_[w];
      to.bodies[k].mobility += g * count[k];
      to.points[p].*root += g * levers[k];
      dlevers[k] += g * (a.*root);
      if (!friction) continue;
      const L lever = edges[v].lever, part = lever * lever * many[v] * g;
      to.edges[v].lever += T(2) * lever * (i + j) * many[v] * g;
      to.vertices[v].soft += part, to.vertices[w].soft += part;
    }
    for (int p : list) {
      const int v = edge(p);
      to.points[p].share += active[p] * (dload[n.after[v]] - dload[v]);
      to.points[p].*root += active[p] * dlevers[body(p)];
    }
  }

  struct Rub {
    L softness, size;
    R slip, trial;
    decltype(L{} > L{}) mobile, sticks;
  };
  Rub rub(int p, const Force<T>& before, const L& normal) const {
    const Solid<T>& b = bodies[body(p)];
    const L one = L{} + T(1), soft = softness(p, &Point<T>::sliding, true);
    const R all = seen(p, change, motion).friction;
    Rub r;
    r.slip = all - points[p].normal * dot(points[p].normal, all);
    r.mobile = (active[p] > T(0)) & (soft > T(0));
    r.softness = r.mobile ? soft : one;
    r.trial = before.friction - r.slip * (r.mobile ? one / r.softness : L{});
    const L squared = dot(r.trial, r.trial);
    const auto zero = squared <= TINY<T> * TINY<T>;
    r.size = zero ? one : root<T>(squared);
    r.sticks = (zero ? L{} : r.size) <= b.mu_s * normal;
    return r;
  }
  const Force<T>& before(int s, int p) const {
    static const Force<T> none{};
    return s ? steps[s - 1].found[p] : none;
  }
  auto presses(int s, int p) const {
    const L along = dot(points[p].normal, apart(p, change, motion));
    return (edges[edge(p)].real > T(0)) & ((before(s, p).normal > T(0)) | (along < points[p].wanted));
  }

  void forward(int s) {
    Step& now = steps[s];
    const L zero{}, one = zero + T(1);
    now.force = force, now.push = push;
    move(now);
    now.pressed.clear(), now.rubbing.clear();
    const size_t known = near.size();
    this->reach();
    for (size_t i = known; i < near.size(); ++i)
      for (Step& each : steps) each.found[near[i]] = Force<T>{};
    for (int p : near) {
      const auto on = presses(s, p);
      now.found[p] = Force<T>{};
      if (!any(on)) continue;
      active[p] = on ? one : zero;
      now.pressed.push_back(p);
    }
    gather(now.pressed, &Point<T>::turning);
    for (int p : now.pressed) {
      const L soft = softness(p, &Point<T>::turning, false), along = dot(points[p].normal, apart(p, change, motion));
      const auto mobile = (active[p] > T(0)) & (soft > T(0));
      L f = before(s, p).normal + (mobile ? (points[p].wanted - along) / (mobile ? soft : one) : zero);
      f = f > T(0) ? f : zero;
      if (!any(f > T(0))) continue;
      now.found[p].normal = f;
      now.rubbing.push_back(p);
    }
    if (n.friction) {
      for (int p : now.rubbing) active[p] = (edges[edge(p)].real > T(0)) & (now.found[p].normal > T(0)) ? one : zero;
      gather(now.rubbing, &Point<T>::sliding);
      for (int p : now.rubbing) {
        const L f = now.found[p].normal;
        const Rub r = rub(p, before(s, p), f);
        const L slides = bodies[body(p)].mu_k * f / r.size;
        now.found[p].friction = r.trial * (r.sticks ? one : slides);
      }
    }
    force.assign(n.vertices, Vec<T>{}), push.assign(n.bodies, Wrench<T>{});
    for (int p : now.rubbing) exert(p, now.found[p].normal, now.found[p].friction, force, push);
  }

  void run() {
    this->prepare();
    force.assign(n.vertices, Vec<T>{}), push.assign(n.bodies, Wrench<T>{});
    for (int s = 0; s < n.sweeps; ++s) forward(s);
  }

  // Goes through a sweep backwards: `by` holds derivatives by its forces, then by those before.
  void backward(int s, List<Force<T>>& by, List<R>& df, List<Wrench<T>>& dm, Inputs<T>& to) {
    Step& now = steps[s];
    const L zero{}, one = zero + T(1);
    List<L> soft(points.size(), zero);
    List<Force<T>> later(points.size());
    // Where nothing presses, forces are constant. Else they count for the next sweep and by what they exert.
    later.swap(by);
    for (int p : now.rubbing) by[p] = later[p];
    for (int p : now.rubbing) {
      const Force<T> d = seen(p, df, dm);
      by[p].normal += d.normal, by[p].friction += d.friction;
      tilt(p, now.found[p].normal, now.found[p].friction, df, dm, to);
    }
    move(now);
    df.assign(n.vertices, Vec<T>{}), dm.assign(n.bodies, Wrench<T>{});
    if (n.friction) {
      for (int p : now.rubbing) active[p] = (edges[edge(p)].real > T(0)) & (now.found[p].normal > T(0)) ? one : zero;
      gather(now.rubbing, &Point<T>::sliding);
      for (int p : now.rubbing) {
        const L f = now.found[p].normal, mu = bodies[body(p)].mu_k;
        const Rub r = rub(p, before(s, p), f);
        const R &d = by[p].friction, way = r.trial * (one / r.size);
        const L along = dot(way, d);
        const L inverse = r.mobile ? one / r.softness : zero;
        const R dtrial = {r.sticks ? d.x : mu * f / r.size * (d.x - way.x * along),
                          r.sticks ? d.y : mu * f / r.size * (d.y - way.y * along),
                          r.sticks ? d.z : mu * f / r.size * (d.z - way.z * along)};
        by[p].normal += r.sticks ? zero : mu * along;
        to.bodies[body(p)].mu_k += r.sticks ? zero : f * along;
        by[p].friction = dtrial;
        soft[p] = dot(dtrial, r.slip) * inverse * inverse;
        slipped(p, dtrial * -inverse, df, dm, to);
      }
      soften(now.rubbing, soft, &Point<T>::sliding, true, to);
    }
    soft.assign(points.size(), zero);
    for (int p : now.pressed) active[p] = presses(s, p) ? one : zero;
    gather(now.pressed, &Point<T>::turning);
    for (int p : now.rubbing) {
      const L give = softness(p, &Point<T>::turning, false), along = dot(points[p].normal, apart(p, change, motion));
      const auto mobile = (active[p] > T(0)) & (give > T(0));
      const L inverse = mobile ? one / (mobile ? give : one) : zero;
      by[p].normal = now.found[p].normal > T(0) ? by[p].normal : zero;
      const L d = by[p].normal * inverse;
      to.points[p].wanted += d;
      soft[p] = -d * (points[p].wanted - along) * inverse;
      exert(p, -d, R{}, df, dm);
      tilt(p, -d, R{}, change, motion, to);
    }
    soften(now.pressed, soft, &Point<T>::turning, false, to);
    for (int v = 0; v < n.vertices; ++v) {
      to.vertices[v].change += df[v];
      to.vertices[v].answer += df[v].times(now.force[v]);
      df[v] = df[v].times(vertices[v].answer);
    }
    for (int k = 0; k < n.bodies; ++k) {
      Solid<T>& d = to.bodies[k];
      const R c = dm[k].force, t = dm[k].torque, w = now.push[k].torque;
      d.change += c, d.turn += t, d.mobility += dot(c, now.push[k].force);
      d.add_turned(t, w);
      dm[k] = {c * bodies[k].mobility, bodies[k].turned(t)};
    }
  }
  // Goes back from points to ropes and bodies. A point that has never been active has no part in the forces.
  void begin(Inputs<T>& to) {
    List<char> used(points.size());
    for (const Step& s : steps)
      for (int p : s.pressed) used[p] = 1;
    this->foresee();
    List<R> dvel(n.vertices);
    List<Wrench<T>> dspin(n.bodies);
    for (int p = 0; p < int(points.size()); ++p)
      if (used[p]) this->place_back(p, to, dvel, dspin);
    for (int v = 0; v < n.vertices; ++v) to.vertices[v].vel += dvel[v];
    for (int k = 0; k < n.bodies; ++k) to.bodies[k].vel += dspin[k].force, to.bodies[k].omega += dspin[k].torque;
  }
  // Adds the derivative by the motion and the geometry of the slip, given as `by`.
  void slipped(int p, const R& by, List<R>& df, List<Wrench<T>>& dm, Inputs<T>& to) const {
    const R& a = points[p].normal;
    const R all = seen(p, change, motion).friction, across = by - a * dot(a, by);
    to.points[p].normal -= by * dot(a, all) + all * dot(a, by);
    exert(p, L{}, across, df, dm);
    tilt(p, L{}, across, change, motion, to);
  }
};

// One per thread and kind of scene: memory for its blocks is asked for once.
template <typename T>
static Block<T>& working(const Sizes& n) {
  static thread_local std::unique_ptr<Block<T>> kept;
  // Equal lists of numbers stand at the same place, see blocks.py.
  const bool fits = kept && kept->n.shape == n.shape && kept->n.pieces == n.pieces && kept->n.after == n.after &&
                    kept->n.bodies == n.bodies && kept->n.vertices == n.vertices && kept->n.sweeps == n.sweeps;
  if (!fits) kept.reset(new Block<T>(n));
  kept->n = n;
  return *kept;
}

#define BLOCKS _Pragma("omp parallel for num_threads(threads)") \
  for (int64_t b = 0; b < n.scenes; b += WIDTH<T>) if (const FlushTiny flush; true)

// Fields of edges, of vertices and of bodies.
template <typename T>
using Fields = T* const* const[3];

template <typename T>
static void sweep(const Fields<const T>& in, T* const* out, T* const* body_out, const Sizes& n, int threads) {
  BLOCKS {
    Block<T>& block = working<T>(n);
    block.all([&](auto& part, int k) { fetch(part, in[k], b, n.scenes); });
    block.run();
    put(block.force, out, b, n.scenes);
    put(block.push, body_out, b, n.scenes);
  }
}

template <typename T>
static void back(const Fields<const T>& in, const T* const* by, const T* const* body_by, const Fields<T>& out,
                 const Sizes& n, int threads) {
  BLOCKS {
    Block<T>& block = working<T>(n);
    block.all([&](auto& part, int k) { fetch(part, in[k], b, n.scenes); });
    block.run();
    Inputs<T> to(n);
    List<Force<T>> forces(block.points.size());
    fetch(block.force, by, b, n.scenes);
    fetch(block.push, body_by, b, n.scenes);
    for (int s = n.sweeps; s--;) block.backward(s, forces, block.force, block.push, to);
    block.begin(to);
    to.all([&](auto& part, int k) { put(part, out[k], b, n.scenes); });
  }
}

#define ENTRY(name, T)                                                                                             \
  extern "C" void name##_sweep(const T* const* e, const T* const* v, const T* const* k, T* const* out,             \
                               T* const* body_out, const Sizes* n, int threads) {                                  \
    sweep<T>({e, v, k}, out, body_out, *n, threads);                                                               \
  }                                                                                                                \
  extern "C" void name##_back(const T* const* e, const T* const* v, const T* const* k, const T* const* by,         \
                              const T* const* body_by, T* const* de, T* const* dv, T* const* dk, const Sizes* n,   \
                              int threads) {                                                                       \
    back<T>({e, v, k}, by, body_by, {de, dv, dk}, *n, threads);                                                    \
  }
ENTRY(body_sweeps_float, float)
ENTRY(body_sweeps_double, double)
