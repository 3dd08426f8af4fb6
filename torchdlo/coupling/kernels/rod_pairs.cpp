// Projected Jacobi sweeps for pairs of edges of ropes, and their derivative; formulas and names as in contact.py.
//
// All arrays have the scenes last: (V, B) for each field of vertices below, (B) for each law, (4, K, B) for where the
// corners of pairs stand on the axis v B + b, (K, B) for whether they are pairs.
//
// One scene is worked on at a time, and several of its pairs side by side: those of a register, or of a warp of a GPU.
#ifndef SIMT
#include <algorithm>
#include <memory>

#include "flush.h"
#endif
#include "rod_pairs.h"

struct Sizes {
  int64_t vertices, scenes, room, sweeps, friction;
  double recovery, slowest, dt;
};
// Numbers of vertices; SOFT is what `Motion.give` returns, FREE the same if none were held.
enum { POS = 0, VEL = 3, CHANGE = 6, ANSWER = 9, SOFT = 12, FREE, RADIUS, FIELDS };
enum { MU_S, MU_K, RESTITUTION, LAWS };

template <typename T>
struct Work {
  typedef Lanes<T> L;
  typedef Num<T, 0> P;
  typedef Three<T, 0> V;
  typedef Force<T> F;
  typedef decltype(L{} > L{}) Mask;
  static constexpr int W = WIDTH<T>, ALL = sizeof(Pair<T>) / sizeof(P);
  struct Group {  // pairs side by side
    int corner[4][W], count;
    L real, pressed;
    Pair<T> pair;
    P apart, slip, wanted;  // how far a newton parts and slips them at most, and by how much they have to part
    bool used;
  };
  const P zero{T(0)}, one{T(1)};
  Sizes n;
  const int size;
  List<T> vertices, by, change, force, load, moved, dload;  // field by field
  List<T> forces;         // on vertices, before each sweep
  List<Group> groups;
  List<F> found;          // after each sweep, by all pairs
  List<char> active;      // whether any is more than none, likewise
  List<Pair<T>> parts;    // derivatives by the pairs
  List<F> later, soft;    // derivatives by their forces, and by how far a newton moves them
  T law[LAWS], by_law[LAWS];

  Work(const Sizes& n, Memory& memory, bool derive) : n(n), size(int(n.vertices)) {
    memory.common(vertices, FIELDS * size), memory.common(change, 3 * size), memory.common(force, 3 * size);
    memory.common(forces, 3 * size * n.sweeps), memory.common(load, size), memory.own(groups, n.room);
    memory.own(found, n.room, n.sweeps), memory.own(active, n.room, n.sweeps);
    if (!derive) return;
    memory.common(by, FIELDS * size), memory.common(moved, 3 * size), memory.common(dload, size);
    memory.own(parts, n.room), memory.own(later, n.room), memory.own(soft, n.room);
  }

  V pick3(const T* field, const int* at) const {
    return {pick(field, at), pick(field + size, at), pick(field + 2 * size, at)};
  }
  void pick4(const T* field, const Group& g, V* x) const {
    for (int c = 0; c < 4; ++c) x[c] = pick3(field, g.corner[c]);
  }
  void drop4(const V* x, T* field, const Group& g) const {
    for (int c = 0; c < 4; ++c)
      for (int k = 0; k < 3; ++k) drop(x[c][k], field + k * size, g.corner[c], g.count);
  }
  static P where(const Mask& mask, const P& x) { return mask ? x.x : L{}; }
  static V where(const Mask& mask, const V& x) { return {where(mask, x.x), where(mask, x.y), where(mask, x.z)}; }
  // Shares of the corners without their sign.
  void shares(const Pair<T>& a, P* to) const { to[0] = one - a.s, to[1] = a.s, to[2] = one - a.t, to[3] = a.t; }

  void read(const T* const* in, const T* const* laws, const int64_t* at, const T* real, int64_t b) {
    for (int f = 0; f < FIELDS; ++f)
      EVERY(v, size) vertices[f * size + v] = in[f][v * n.scenes + b];
    for (int f = 0; f < LAWS; ++f) law[f] = laws[f][b];
    groups.clear();
    EVERY(k, n.room) {
      if (!(real[k * n.scenes + b] > T(0))) continue;
      if (groups.empty() || groups.back().count == W) groups.emplace_back(), groups.back().count = 0;
      Group& g = groups.back();
      const int lane = g.count++;
      // Lanes that stay free do what the first does.
      for (int c = 0; c < 4; ++c)
        for (int i = lane; i < (lane ? lane + 1 : W); ++i)
          g.corner[c][i] = int(at[(c * n.room + k) * n.scenes + b] / n.scenes);
    }
  }

  Corners<T> corners(const Group& g) const {
    Corners<T> c;
    pick4(&vertices[POS * size], g, c.pos);
    for (int i = 0; i < 4; ++i) c.free[i] = pick(&vertices[FREE * size], g.corner[i]);
    for (int k = 0; k < 2; ++k) c.radius[k] = pick(&vertices[RADIUS * size], g.corner[2 * k]);
    return c;
  }
  P approach(const Group& g) const {
    V vel[4];
    pick4(&vertices[VEL * size], g, vel);
    return -dot(g.pair.normal, apart(g.pair, vel));
  }
  P rebound(const Group& g) const {
    if (!(law[RESTITUTION] > T(0)) || !any(g.pressed > T(0))) return zero;
    const P fast = approach(g);
    return where((g.pressed > T(0)) & (fast.x > T(n.slowest)), fast * P(law[RESTITUTION] * T(n.dt)));
  }
  static Mask bounces(const Group& g, const P& back) { return (back.x > T(0)) & (back.x > g.pair.wanted.x); }
  void prepare() {
    blank(load);
    meet();
    for (Group& g : groups) {
      g.pair = pair(corners(g), n.friction, T(n.recovery));
      for (int i = 0; i < W; ++i) g.real[i] = T(i < g.count);
      // What is not a number stays so.
      g.real = dot(g.pair.between, g.pair.between).x <= TINY<T> * TINY<T> ? L{} : g.real;
      V x[4];
      pick4(&vertices[CHANGE * size], g, x);
      g.pressed = dot(g.pair.normal, apart(g.pair, x)).x < g.pair.wanted.x ? g.real : L{};
      g.used = any(g.pressed > T(0));
      const P back = rebound(g);
      g.wanted = select(bounces(g, back), back, g.pair.wanted);
      if (!g.used) continue;
      P w[4];
      shares(g.pair, w);
      for (int c = 0; c < 4; ++c) drop(w[c] * P(g.pressed), load.data(), g.corner[c], g.count);
    }
    meet();
    for (Group& g : groups) soften(g);
  }
  void soften(Group& g) const {
    P w[4];
    shares(g.pair, w);
    g.apart = zero, g.slip = n.friction ? g.pair.turning : zero;
    for (int c = 0; c < 4; ++c) {
      const P many = w[c] * (pick(load.data(), g.corner[c]) + (one - P(g.pressed)) * w[c]);
      g.apart = g.apart + many * pick(&vertices[SOFT * size], g.corner[c]);
      g.slip = g.slip + many * pick(&vertices[FREE * size], g.corner[c]);
    }
  }

  struct Rub {
    P size;
    V slip, trial;
    Mask sticks;
  };
  Rub rub(const Group& g, const F& before, const F& moved, const P& normal) const {
    Rub r;
    r.slip = moved.friction - g.pair.normal * dot(g.pair.normal, moved.friction);
    r.trial = before.friction - r.slip * where(g.real > T(0), one / g.slip);
    const P squared = dot(r.trial, r.trial);
    const Mask none = squared.x <= TINY<T> * TINY<T>;
    r.size = root(select(none, one, squared));
    r.sticks = select(none, zero, r.size).x <= law[MU_S] * normal.x;
    return r;
  }
  size_t place(int s, size_t g) const { return s * groups.size() + g; }
  F before(int s, size_t g) const { return s ? found[place(s - 1, g)] : F{zero, {zero, zero, zero}}; }
  // By what factor the normal force answers to what a pair still has to part.
  P stiffness(const Group& g) const {
    const Mask mobile = (g.real > T(0)) & (g.apart.x > T(0));
    return where(mobile, one / select(mobile, g.apart, one));
  }
  void move(int s) {
    EVERY(i, 3 * size)
      change[i] = vertices[CHANGE * size + i] + vertices[ANSWER * size + i] * forces[3 * size * s + i];
  }

  void forward(int s) {
    EVERY(i, 3 * size) forces[3 * size * s + i] = force[i];
    move(s);
    blank(force);
    meet();
    for (size_t k = 0; k < groups.size(); ++k) {
      Group& g = groups[k];
      V x[4];
      pick4(change.data(), g, x);
      const F moved = seen(g.pair, x, n.friction), last = before(s, k);
      F& f = found[place(s, k)];
      f.normal = positive(last.normal + stiffness(g) * (g.wanted - moved.normal));
      f.friction = {zero, zero, zero};
      const Mask on = ~(f.normal.x <= T(0));
      active[place(s, k)] = any(on);
      if (!any(on)) continue;
      g.used = true;
      if (n.friction) {
        const Rub r = rub(g, last, moved, f.normal);
        f.friction = where(on, r.trial * select(r.sticks, one, P(law[MU_K]) * f.normal / r.size));
      }
      exert(g.pair, f, n.friction, x);
      drop4(x, force.data(), g);
    }
    meet();
  }
  void run() {
    found.resize(n.sweeps * groups.size()), active.resize(n.sweeps * groups.size());
    meet();
    prepare();
    blank(force);
    for (int s = 0; s < n.sweeps; ++s) forward(s);
  }

  // Makes of `d`, the derivative by forces after a sweep, that by those before; adds those by how far a newton slips a
  // pair and by how it moves.
  void rub_back(size_t k, const Rub& r, const F& moved, const P& normal, F& d, F& soft, F& back) {
    const Group& g = groups[k];
    const Mask on = ~(normal.x <= T(0));
    const V way = r.trial * (one / r.size);
    const P along = dot(way, d.friction), mu(law[MU_K]), slides = mu * normal / r.size;
    const V &whole = d.friction, turned = (whole - way * along) * slides;
    const V trial = where(on, V{select(r.sticks, whole.x, turned.x), select(r.sticks, whole.y, turned.y),
                                select(r.sticks, whole.z, turned.z)});
    const P rubs = where(on & ~r.sticks, along), inverse = where(g.real > T(0), one / g.slip);
    d.normal = d.normal + mu * rubs, d.friction = trial;
    by_law[MU_K] += sum(normal * rubs, g.count);
    soft.friction.x = soft.friction.x + dot(trial, r.slip) * inverse * inverse;
    const V slip = trial * -inverse;
    back.friction = slip - g.pair.normal * dot(g.pair.normal, slip);
    parts[k].normal -= slip * dot(g.pair.normal, moved.friction) + moved.friction * dot(g.pair.normal, slip);
  }
  // Goes through a sweep backwards: `later` holds derivatives by its forces, then by those before; `force` by what the
  // forces exert on vertices, likewise.
  void backward(int s) {
    move(s);
    blank(moved);
    meet();
    for (size_t k = 0; k < groups.size(); ++k) {
      if (!active[place(s, k)]) {
        later[k] = F{zero, {zero, zero, zero}};
        continue;
      }
      const Group& g = groups[k];
      const F &f = found[place(s, k)], last = before(s, k);
      const Mask on = ~(f.normal.x <= T(0));
      V x[4];
      pick4(force.data(), g, x);
      F d = seen(g.pair, x, n.friction);
      d.normal = d.normal + later[k].normal, d.friction += later[k].friction;
      tilt(g.pair, f, x, n.friction, parts[k]);
      pick4(change.data(), g, x);
      const F m = seen(g.pair, x, n.friction);
      F back{zero, {zero, zero, zero}};  // derivative by how the pair moves
      if (n.friction) rub_back(k, rub(g, last, m, f.normal), m, f.normal, d, soft[k], back);
      d.normal = where(on, d.normal);
      const P stiff = stiffness(g), part = d.normal * stiff;
      parts[k].wanted = parts[k].wanted + part;
      soft[k].normal = soft[k].normal - part * (g.wanted - m.normal) * stiff;
      back.normal = -part;
      later[k] = d;
      tilt(g.pair, back, x, n.friction, parts[k]);
      exert(g.pair, back, n.friction, x);
      drop4(x, moved.data(), g);
    }
    meet();
    EVERY(i, 3 * size) {
      by[CHANGE * size + i] += moved[i];
      by[ANSWER * size + i] += moved[i] * forces[3 * size * s + i];
      force[i] = moved[i] * vertices[ANSWER * size + i];
    }
  }

  // Adds the derivative of how far pairs part and slip under a newton.
  void soften_back() {
    blank(dload);
    meet();
    for (size_t k = 0; k < groups.size(); ++k) {
      const Group& g = groups[k];
      if (!g.used) continue;
      const P &i = soft[k].normal, &j = soft[k].friction.x, mine = one - P(g.pressed);
      P w[4], dw[4];
      shares(g.pair, w);
      for (int c = 0; c < 4; ++c) {
        const int* at = g.corner[c];
        const P many = pick(load.data(), at), own = mine * w[c];
        const P gives = i * pick(&vertices[SOFT * size], at) + j * pick(&vertices[FREE * size], at);
        dw[c] = gives * (many + own + own);
        drop(w[c] * gives, dload.data(), at, g.count);
        drop(i * w[c] * (many + own), &by[SOFT * size], at, g.count);
        drop(j * w[c] * (many + own), &by[FREE * size], at, g.count);
      }
      parts[k].s = parts[k].s + dw[1] - dw[0], parts[k].t = parts[k].t + dw[3] - dw[2];
      parts[k].turning = parts[k].turning + j;
    }
    meet();
    for (size_t k = 0; k < groups.size(); ++k) {
      const Group& g = groups[k];
      if (!any(g.pressed > T(0))) continue;
      P d[4];
      for (int c = 0; c < 4; ++c) d[c] = pick(dload.data(), g.corner[c]) * P(g.pressed);
      parts[k].s = parts[k].s + d[1] - d[0], parts[k].t = parts[k].t + d[3] - d[2];
    }
  }
  void place_back(size_t k) {
    const Group& g = groups[k];
    Pair<T>& d = parts[k];
    const P back = rebound(g);
    const Mask bounced = bounces(g, back);
    if (any(bounced)) {
      const P by_back = where(bounced, d.wanted) * P(T(n.dt)), e(law[RESTITUTION]);
      d.wanted = where(~bounced, d.wanted);
      by_law[RESTITUTION] += sum(by_back * approach(g), g.count);
      const F f{-(by_back * e), {zero, zero, zero}};
      V x[4];
      pick4(&vertices[VEL * size], g, x);
      tilt(g.pair, f, x, false, d);
      exert(g.pair, f, false, x);
      drop4(x, &by[VEL * size], g);
    }
    Corners<T> to;
    for (int i = 0; i < int(sizeof(to) / sizeof(P)); ++i) ((P*)&to)[i] = zero;
    pair_back(corners(g), g.pair, n.friction, T(n.recovery), d, to);
    for (int i = 0; i < 4; ++i) {
      for (int j = 0; j < 3; ++j) drop(to.pos[i][j], &by[(POS + j) * size], g.corner[i], g.count);
      drop(to.free[i], &by[FREE * size], g.corner[i], g.count);
    }
    for (int i = 0; i < 2; ++i) drop(to.radius[i], &by[RADIUS * size], g.corner[2 * i], g.count);
  }

  // Makes of `force`, the derivative by forces on vertices, those by all inputs.
  void back() {
    const F none{zero, {zero, zero, zero}};
    Pair<T> nothing;
    for (int i = 0; i < ALL; ++i) ((P*)&nothing)[i] = zero;
    for (List<F>* x = &later;; x = &soft) {
      x->resize(groups.size());
      for (F& each : *x) each = none;
      if (x == &soft) break;
    }
    parts.resize(groups.size());
    for (Pair<T>& each : parts) each = nothing;
    for (T& each : by_law) each = T(0);
    blank(by);
    for (int s = int(n.sweeps); s--;) backward(s);
    meet();
    soften_back();
    for (size_t k = 0; k < groups.size(); ++k)
      if (groups[k].used) place_back(k);
    for (T& each : by_law) each = total(each);
    meet();
  }

  void write(const List<T>& from, int fields, T* const* to, int64_t b) const {
    for (int f = 0; f < fields; ++f)
      EVERY(v, size) to[f][v * n.scenes + b] = from[f * size + v];
  }
};

#ifndef SIMT
// One per thread and kind of scene: memory is asked for once.
template <typename T>
static Work<T>& working(const Sizes& n) {
  static thread_local std::unique_ptr<Work<T>> kept;
  Memory memory;
  if (!kept || kept->n.vertices != n.vertices || kept->n.sweeps != n.sweeps) kept.reset(new Work<T>(n, memory, true));
  kept->n = n;
  return *kept;
}

// Neighbouring scenes share lines of memory.
#define SCENES                                                            \
  _Pragma("omp parallel for schedule(static, 8) num_threads(threads)") \
  for (int64_t b = 0; b < n.scenes; ++b) if (const FlushTiny flush; true)

template <typename T>
static void sweep(const T* const* in, const T* const* laws, const int64_t* at, const T* real, T* const* out,
                  const Sizes& n, int threads) {
  SCENES {
    Work<T>& w = working<T>(n);
    w.read(in, laws, at, real, b);
    w.run();
    w.write(w.force, 3, out, b);
  }
}

template <typename T>
static void back(const T* const* in, const T* const* laws, const int64_t* at, const T* real, const T* const* by,
                 T* const* out, T* const* out_laws, const Sizes& n, int threads) {
  SCENES {
    Work<T>& w = working<T>(n);
    w.read(in, laws, at, real, b);
    w.run();
    for (int k = 0; k < 3; ++k)
      for (int v = 0; v < w.size; ++v) w.force[k * w.size + v] = by[k][v * n.scenes + b];
    w.back();
    w.write(w.by, FIELDS, out, b);
    for (int f = 0; f < LAWS; ++f) out_laws[f][b] = w.by_law[f];
  }
}

#define ENTRY(name, T)                                                                                              \
  extern "C" void name##_sweep(const T* const* in, const T* const* laws, const int64_t* at, const T* real,          \
                               T* const* out, const Sizes* n, int threads) {                                        \
    sweep<T>(in, laws, at, real, out, *n, threads);                                                                 \
  }                                                                                                                 \
  extern "C" void name##_back(const T* const* in, const T* const* laws, const int64_t* at, const T* real,           \
                              const T* const* by, T* const* out, T* const* out_laws, const Sizes* n, int threads) { \
    back<T>(in, laws, at, real, by, out, out_laws, *n, threads);                                                    \
  }
ENTRY(rod_pairs_float, float)
ENTRY(rod_pairs_double, double)
#else
// Arrays stand in the order of the arguments above.
template <typename T>
static void sweep(const Sizes& n, const Fields& p, const Room& room, bool derive) {
  Memory memory = room.memory();
  Work<T> w(n, memory, derive);
  const int laws = FIELDS, at = laws + LAWS, by = at + 2, out = by + derive * 3;
  for (int64_t b = first_scene(); b < n.scenes; b += scene_step()) {
    w.read(p.from<const T>(0), p.from<const T>(laws), (const int64_t*)p.at[at], (const T*)p.at[at + 1], b);
    w.run();
    if (!derive) {
      w.write(w.force, 3, p.from<T>(out), b);
    } else {
      for (int k = 0; k < 3; ++k)
        EVERY(v, w.size) w.force[k * w.size + v] = p.from<const T>(by)[k][v * n.scenes + b];
      meet();
      w.back();
      w.write(w.by, FIELDS, p.from<T>(out), b);
      if (lane() == 0)
        for (int f = 0; f < LAWS; ++f) p.from<T>(out + FIELDS)[f][b] = w.by_law[f];
    }
    meet();
  }
}
template <typename T>
static void count(const Sizes& n, const Fields& p, bool derive) {
  Memory memory{};
  Work<T> w(n, memory, derive);
  memory.report(p);
}
#if DERIVE
KERNEL(rod_pairs_back, Sizes) { sweep<NUMBER>(n, p, room, true); }
KERNEL(rod_pairs_back_memory, Sizes) { count<NUMBER>(n, p, true); }
#else
KERNEL(rod_pairs_sweep, Sizes) { sweep<NUMBER>(n, p, room, false); }
KERNEL(rod_pairs_sweep_memory, Sizes) { count<NUMBER>(n, p, false); }
#endif
#endif
