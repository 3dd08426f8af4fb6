// Projected Jacobi sweeps for points of ropes on bodies, and their derivative; formulas and names as in rod_body.py.
//
// All arrays have the scenes last: (V, B) or (K, B) for each field of the structs in body_points.h, force on vertices (3),
// force and torque on bodies (6).
//
// A block of scenes is worked on side by side; points that are active in none of them cost next to nothing. On a GPU a
// warp works on one scene, and its lanes on edges: what belongs to an edge, and to points of it, is only theirs.
#include "body_points.h"
#ifndef SIMT
#include "flush.h"

#include <memory>
#include <vector>
#endif

template <typename T>
struct Block : Geometry<T> {
  typedef Geometry<T> G;
  using G::points, G::edges, G::vertices, G::bodies, G::n, G::change, G::motion;
  using G::near, G::edge, G::body, G::apart, G::exert, G::seen, G::tilt;
  typedef Lanes<T> L;
  typedef Vec<T> R;
  struct Part {  // some of a list
    const int *from, *to;
    const int* begin() const { return from; }
    const int* end() const { return to; }
  };
  struct Tally {  // sums over points of a body
    L count, levers;
  };
  struct Drag {
    Wrench<T> push;
    L mu;
  };
  bool quiet;                     // whether nothing touches
  const bool derive;              // otherwise only the last sweep is kept, and the one before
  List<R> forces;                 // on vertices, before each sweep
  List<Wrench<T>> pushes;         // on bodies, likewise
  List<Force<T>> found;           // by points, after each sweep
  List<int> pressed, rubbing;     // points that are active in some scene, sweep after sweep
  List<int> presses_to, rubs_to;  // where those of each sweep end
  List<R> force, dvel;
  List<Wrench<T>> push, dspin;
  List<Tally> tally, dtally;
  List<Drag> drags;
  List<L> active, load_, many, dload, soft;
  List<Force<T>> by, later;  // derivatives by forces
  List<char> used;
  Inputs<T> to;

  Block(const Sizes& n, Memory& memory, bool derive) : G(n, memory), derive(derive) {
    const int64_t all = points.size(), kept = derive ? n.sweeps : 1;
    memory.common(load_, n.vertices), memory.common(many, n.vertices);
    memory.common(tally, n.bodies);
    memory.common(forces, n.vertices * kept), memory.common(pushes, n.bodies * kept);
    memory.common(force, n.vertices), memory.common(push, n.bodies);
    memory.large(found, all * (derive ? n.sweeps : 2)), memory.large(active, all);
    memory.own(pressed, n.vertices, n.families * kept), memory.own(rubbing, n.vertices, n.families * kept);
    memory.own(presses_to, 1, kept), memory.own(rubs_to, 1, kept);
    if (!derive) return;
    memory.common(dload, n.vertices), memory.common(dtally, n.bodies), memory.common(drags, n.bodies);
    memory.common(dvel, n.vertices), memory.common(dspin, n.bodies);
    memory.large(soft, all), memory.large(by, all), memory.large(later, all), memory.large(used, all);
    to.take(n, memory);
  }

  int kept(int s) const { return derive ? s : 0; }
  size_t at(int s, int p) const { return (derive ? s : s & 1) * points.size() + p; }
  // What points of a list add to sums of their bodies: work(p, sum).
  template <class S, class W>
  void by_body(const Part& list, List<S>& sums, W work) const {
#ifdef SIMT
    for (int k = 0; k < n.bodies; ++k) {
      Own<T, S> own(sums[k]);
      for (int p : list)
        if (body(p) == k) work(p, own.sum);
    }
#else
    for (int p : list) work(p, sums[body(p)]);
#endif
  }
  static Part part(const List<int>& list, const List<int>& ends, int s) {
    return {list.data() + (s ? ends[s - 1] : 0), list.data() + ends[s]};
  }
  Part pressing(int s) const { return part(pressed, presses_to, kept(s)); }
  Part rubbers(int s) const { return part(rubbing, rubs_to, kept(s)); }
  // Sets what belongs to points, each lane its own.
  template <class S>
  void blank_points(List<S>& list) const {
    for (int f = 0; f < n.families; ++f) EVERY(v, n.vertices) list[f * n.vertices + v] = S{};
  }

  void move(int s) {
    EVERY(v, n.vertices) change[v] = vertices[v].change + vertices[v].answer.times(forces[kept(s) * n.vertices + v]);
    EVERY(k, n.bodies) {
      const Solid<T>& b = bodies[k];
      const Wrench<T>& by = pushes[kept(s) * n.bodies + k];
      motion[k] = {b.change + by.force * b.mobility, b.turn + b.turned(by.torque)};
    }
  }

  // Sums over active points that all softness is made of; `root` is the turning or the sliding part of a point.
  void gather(const Part& list, L Point<T>::*root) {
    meet();
    blank(load_), blank(many), blank(tally);
    meet();
    by_body(list, tally, [&](int p, Tally& sum) {
      const L on = active[p], &s = points[p].share;
      const int v = edge(p);
      ADD(load_[v], on * (T(1) - s)), ADD(load_[n.after[v]], on * s), many[v] += on;
      sum.count += on, sum.levers += on * (points[p].*root);
    });
    meet();
  }
  L softness(int p, L Point<T>::*root, bool friction) const {
    const Point<T>& a = points[p];
    const int v = edge(p), w = n.after[v], k = body(p);
    const L i = vertices[v].soft, j = vertices[w].soft, lever = edges[v].lever;
    L sum = (T(1) - a.share) * load_[v] * i + a.share * load_[w] * j;
    sum += bodies[k].mobility * tally[k].count + (a.*root) * tally[k].levers;
    return friction ? sum + lever * lever * (i + j) * many[v] : sum;
  }
  // Adds the derivative of the softness of all points, given as `by`.
  void soften(const Part& list, L Point<T>::*root, bool friction) {
    meet();
    blank(dload), blank(dtally);
    meet();
    by_body(list, dtally, [&](int p, Tally& sum) {
      const Point<T>& a = points[p];
      const int v = edge(p), w = n.after[v], k = body(p);
      const L i = vertices[v].soft, j = vertices[w].soft, g = soft[p], one = (T(1) - a.share) * g, two = a.share * g;
      to.points[p].share += g * (load_[w] * j - load_[v] * i);
      ADD(dload[v], one * i), ADD(dload[w], two * j);
      ADD(to.vertices[v].soft, one * load_[v]), ADD(to.vertices[w].soft, two * load_[w]);
      to.points[p].*root += g * tally[k].levers;
      sum.count += g * tally[k].count, sum.levers += g * (a.*root);
      if (!friction) return;
      const L lever = edges[v].lever, part = lever * lever * many[v] * g;
      to.edges[v].lever += T(2) * lever * (i + j) * many[v] * g;
      ADD(to.vertices[v].soft, part), ADD(to.vertices[w].soft, part);
    });
    meet();
    EVERY(k, n.bodies) to.bodies[k].mobility += dtally[k].count;
    for (int p : list) {
      const int v = edge(p);
      to.points[p].share += active[p] * (dload[n.after[v]] - dload[v]);
      to.points[p].*root += active[p] * dtally[body(p)].levers;
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
  Force<T> before(int s, int p) const { return s ? found[at(s - 1, p)] : Force<T>{}; }
  auto presses(int s, int p) const {
    const L along = dot(points[p].normal, apart(p, change, motion));
    return (edges[edge(p)].real > T(0)) & ((before(s, p).normal > T(0)) | (along < points[p].wanted));
  }

  void forward(int s) {
    const L zero{}, one = zero + T(1);
    if (!derive) pressed.clear(), rubbing.clear(), presses_to.clear(), rubs_to.clear();
    EVERY(v, n.vertices) forces[kept(s) * n.vertices + v] = force[v];
    EVERY(k, n.bodies) pushes[kept(s) * n.bodies + k] = push[k];
    move(s);
    meet();
    const size_t known = near.size();
    if (this->reach()) {
      move(s);
      meet();
    }
    for (size_t i = known; i < size_t(near.size()); ++i)
      for (int each = 0; each < (derive ? n.sweeps : 2); ++each) found[at(each, near[i])] = Force<T>{};
    for (int p : near) {
      const auto on = presses(s, p);
      found[at(s, p)] = Force<T>{};
      if (!any(on)) continue;
      active[p] = on ? one : zero;
      pressed.push_back(p);
    }
    presses_to.push_back(int(pressed.size()));
    gather(pressing(s), &Point<T>::turning);
    for (int p : pressing(s)) {
      const L soft = softness(p, &Point<T>::turning, false), along = dot(points[p].normal, apart(p, change, motion));
      const auto mobile = (active[p] > T(0)) & (soft > T(0));
      L f = before(s, p).normal + (mobile ? (points[p].wanted - along) / (mobile ? soft : one) : zero);
      f = f > T(0) ? f : zero;
      if (!any(f > T(0))) continue;
      found[at(s, p)].normal = f;
      rubbing.push_back(p);
    }
    rubs_to.push_back(int(rubbing.size()));
    if (n.friction) {
      for (int p : rubbers(s)) active[p] = presses_now(s, p);
      gather(rubbers(s), &Point<T>::sliding);
      for (int p : rubbers(s)) {
        const L f = found[at(s, p)].normal;
        const Rub r = rub(p, before(s, p), f);
        const L slides = bodies[body(p)].mu_k * f / r.size;
        found[at(s, p)].friction = r.trial * (r.sticks ? one : slides);
      }
    }
    blank(force), blank(push);
    meet();
    by_body(rubbers(s), push, [&](int p, Wrench<T>& sum) {
      exert(p, found[at(s, p)].normal, found[at(s, p)].friction, force, sum);
    });
    meet();
  }
  L presses_now(int s, int p) const {
    const L zero{}, one = zero + T(1);
    return (edges[edge(p)].real > T(0)) & (found[at(s, p)].normal > T(0)) ? one : zero;
  }

  void run() {
    this->prepare();
    meet();
    blank(force), blank(push);
    pressed.clear(), rubbing.clear(), presses_to.clear(), rubs_to.clear();
    forward(0);
    // Nothing exerts forces then, and all sweeps are like the first.
    quiet = !anyone(!rubbing.empty());
    for (int s = 1; s < n.sweeps && !quiet; ++s) forward(s);
  }

  // Goes through a sweep backwards: `by` holds derivatives by its forces, then by those before.
  void backward(int s, List<R>& df, List<Wrench<T>>& dm) {
    const L zero{}, one = zero + T(1);
    blank_points(soft), blank_points(later);
    // Where nothing presses, forces are constant. Else they count for the next sweep and by what they exert.
    later.swap(by);
    for (int p : rubbers(s)) by[p] = later[p];
    for (int p : rubbers(s)) {
      const Force<T> d = seen(p, df, dm);
      by[p].normal += d.normal, by[p].friction += d.friction;
      tilt(p, found[at(s, p)].normal, found[at(s, p)].friction, df, dm, to);
    }
    meet();
    move(s);
    blank(df), blank(dm), blank(drags);
    meet();
    if (n.friction) {
      for (int p : rubbers(s)) active[p] = presses_now(s, p);
      gather(rubbers(s), &Point<T>::sliding);
      by_body(rubbers(s), drags, [&](int p, Drag& sum) {
        const L f = found[at(s, p)].normal, mu = bodies[body(p)].mu_k;
        const Rub r = rub(p, before(s, p), f);
        const R &d = by[p].friction, way = r.trial * (one / r.size);
        const L along = dot(way, d);
        const L inverse = r.mobile ? one / r.softness : zero;
        const R dtrial = {r.sticks ? d.x : mu * f / r.size * (d.x - way.x * along),
                          r.sticks ? d.y : mu * f / r.size * (d.y - way.y * along),
                          r.sticks ? d.z : mu * f / r.size * (d.z - way.z * along)};
        by[p].normal += r.sticks ? zero : mu * along;
        sum.mu += r.sticks ? zero : f * along;
        by[p].friction = dtrial;
        soft[p] = dot(dtrial, r.slip) * inverse * inverse;
        slipped(p, dtrial * -inverse, df, sum.push);
      });
      meet();
      EVERY(k, n.bodies) {
        dm[k].force += drags[k].push.force, dm[k].torque += drags[k].push.torque;
        to.bodies[k].mu_k += drags[k].mu;
      }
      soften(rubbers(s), &Point<T>::sliding, true);
    }
    blank_points(soft);
    for (int p : pressing(s)) active[p] = presses(s, p) ? one : zero;
    gather(pressing(s), &Point<T>::turning);
    by_body(rubbers(s), dm, [&](int p, Wrench<T>& sum) {
      const L give = softness(p, &Point<T>::turning, false), along = dot(points[p].normal, apart(p, change, motion));
      const auto mobile = (active[p] > T(0)) & (give > T(0));
      const L inverse = mobile ? one / (mobile ? give : one) : zero;
      by[p].normal = found[at(s, p)].normal > T(0) ? by[p].normal : zero;
      const L d = by[p].normal * inverse;
      to.points[p].wanted += d;
      soft[p] = -d * (points[p].wanted - along) * inverse;
      exert(p, -d, R{}, df, sum);
      tilt(p, -d, R{}, change, motion, to);
    });
    soften(pressing(s), &Point<T>::turning, false);
    meet();
    EVERY(v, n.vertices) {
      to.vertices[v].change += df[v];
      to.vertices[v].answer += df[v].times(forces[kept(s) * n.vertices + v]);
      df[v] = df[v].times(vertices[v].answer);
    }
    EVERY(k, n.bodies) {
      Solid<T>& d = to.bodies[k];
      const Wrench<T>& pushed = pushes[kept(s) * n.bodies + k];
      const R c = dm[k].force, t = dm[k].torque, w = pushed.torque;
      d.change += c, d.turn += t, d.mobility += dot(c, pushed.force);
      d.add_turned(t, w);
      dm[k] = {c * bodies[k].mobility, bodies[k].turned(t)};
    }
    meet();
  }
  // Goes back from points to ropes and bodies. A point that has never been active has no part in the forces.
  void begin() {
    blank_points(used);
    for (int p : pressed) used[p] = 1;
    this->foresee();
    blank(dvel), blank(dspin);
    meet();
    for (int k = 0, f = 0; k < n.bodies; ++k) {
      Own<T, Solid<T>> body(to.bodies[k]);
      Own<T, Wrench<T>> spin(dspin[k]);
      for (const int end = f + 2 + int(n.pieces[k]); f < end; ++f)
        EVERY(v, n.vertices)
          if (used[f * n.vertices + v]) this->place_back(f * n.vertices + v, to, body.sum, dvel, spin.sum);
    }
    meet();
    EVERY(v, n.vertices) to.vertices[v].vel += dvel[v];
    EVERY(k, n.bodies) to.bodies[k].vel += dspin[k].force, to.bodies[k].omega += dspin[k].torque;
    meet();
  }
  // Adds the derivative by the motion and the geometry of the slip, given as `by`.
  void slipped(int p, const R& by, List<R>& df, Wrench<T>& dm) {
    const R& a = points[p].normal;
    const R all = seen(p, change, motion).friction, across = by - a * dot(a, by);
    to.points[p].normal -= by * dot(a, all) + all * dot(a, by);
    exert(p, L{}, across, df, dm);
    tilt(p, L{}, across, change, motion, to);
  }
  // Makes of `force` and `push`, the derivatives by what is exerted, those by all inputs.
  void back() {
    blank(to.edges), blank(to.vertices), blank(to.bodies);
    if (quiet) return meet();
    blank_points(to.points), blank_points(by);
    meet();
    for (int s = int(n.sweeps); s--;) backward(s, force, push);
    begin();
  }
};

#ifndef SIMT
// One per thread and kind of scene: memory for its blocks is asked for once.
template <typename T>
static Block<T>& working(const Sizes& n) {
  static thread_local std::unique_ptr<Block<T>> kept;
  Memory memory;
  // Equal lists of numbers stand at the same place, see blocks.py.
  const bool fits = kept && kept->n.shape == n.shape && kept->n.pieces == n.pieces && kept->n.after == n.after &&
                    kept->n.bodies == n.bodies && kept->n.vertices == n.vertices && kept->n.sweeps == n.sweeps;
  if (!fits) kept.reset(new Block<T>(n, memory, true)), kept->number();
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
    fetch(block.force, by, b, n.scenes);
    fetch(block.push, body_by, b, n.scenes);
    block.back();
    block.to.all([&](auto& part, int k) { put(part, out[k], b, n.scenes); });
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
#else
// Arrays stand in the order of the arguments above.
template <typename T>
static void sweep(const Sizes& n, const Fields& p, const Room& room, bool derive) {
  Memory memory = room.memory();
  Block<T> block(n, memory, derive);
  const int each[3] = {sizeof(Edge<T>) / sizeof(T), sizeof(Vertex<T>) / sizeof(T), sizeof(Solid<T>) / sizeof(T)};
  const int first[4] = {0, each[0], each[0] + each[1], each[0] + each[1] + each[2]};
  const int by = first[3], out = by + derive * 9;
  block.number();
  for (int64_t b = first_scene(); b < n.scenes; b += scene_step()) {
    block.all([&](auto& part, int k) { fetch(part, p.from<const T>(first[k]), b, n.scenes); });
    meet();
    block.run();
    if (!derive) {
      put(block.force, p.from<T>(out), b, n.scenes);
      put(block.push, p.from<T>(out + 3), b, n.scenes);
    } else {
      fetch(block.force, p.from<const T>(by), b, n.scenes);
      fetch(block.push, p.from<const T>(by + 3), b, n.scenes);
      block.back();
      block.to.all([&](auto& part, int k) { put(part, p.from<T>(out + first[k]), b, n.scenes); });
    }
    meet();
  }
}
template <typename T>
static void count(const Sizes& n, const Fields& p, bool derive) {
  Memory memory{};
  Block<T> block(n, memory, derive);
  memory.report(p);
}
#if DERIVE
KERNEL(body_sweeps_back, Sizes) { sweep<NUMBER>(n, p, room, true); }
KERNEL(body_sweeps_back_memory, Sizes) { count<NUMBER>(n, p, true); }
#else
KERNEL(body_sweeps_sweep, Sizes) { sweep<NUMBER>(n, p, room, false); }
KERNEL(body_sweeps_sweep_memory, Sizes) { count<NUMBER>(n, p, false); }
#endif
#endif
