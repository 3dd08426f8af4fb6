// Contact among rigid bodies, and its derivative; formulas and names as in body_contact.py, balls.py and linked.py.
//
// All arrays have the scenes last: (K, B) for each field of Member in body_balls.h, force and torque on bodies (6), and
// if asked for how these fall with the displacement of the body (36, row by row).
//
// A block of scenes is worked on side by side; pairs that are far apart in all of them cost next to nothing.
#include "body_links.h"
#include "elimination.h"
#include "flush.h"

#include <limits>
#include <memory>

template <typename T, int N>
struct Held {
  Wrench<T, N> wrench;
  Num<T, N> hold[36];
};

template <typename T>
struct Block : Linked<T> {
  typedef Lanes<T> L;
  typedef Num<T, 0> P;
  typedef Three<T, 0> V;
  using Pairs<T>::n, Pairs<T>::zero, Pairs<T>::one, Pairs<T>::start, Pairs<T>::first, Pairs<T>::owner;
  using Pairs<T>::bodies, Pairs<T>::active, Pairs<T>::contacts, Pairs<T>::FIELDS, Pairs<T>::ALL;
  using Linked<T>::stiff, Linked<T>::sets, Linked<T>::seen, Linked<T>::slip;
  template <int N>
  using Bodies = List<Member<T, N>>;
  template <int N>
  using Wrenches = List<Wrench<T, N>>;
  Blocks<T> system;
  List<L> load;
  List<Link<T, 0>> links;
  List<L> motion;  // of free bodies
  bool near;

  explicit Block(const Sizes& n) : Linked<T>(n), system(places(n)) {
    for (int p = 0; p < n.pairs; ++p) {
      const int64_t a = n.free[n.pair[2 * p]], b = n.free[n.pair[2 * p + 1]];
      if (a >= 0 && b >= 0) system.couple(int(a), int(b));
    }
    system.plan();
    stiff.resize(owner.size()), load.resize(owner.size()), sets.resize(owner.size());
  }
  static int places(const Sizes& n) {
    int count = 0;
    for (int k = 0; k < n.bodies; ++k) count += n.free[k] >= 0;
    return count;
  }
  // Which contacts press and slide, after those of the last round moved the points of a pair.
  void update(int p, const List<V>& moved) {
    const int from = first[p], to = first[p + 1];
    List<L> sizes(to - from);
    List<V> ways(to - from);
    L rubs{}, whole{}, most{};
    for (int c = from; c < to; ++c) {
      const L over = links[c].wanted.x - dot(links[c].normal, moved[c]).x, press = sets[c].press;
      load[c] = stiff[c] * (over > T(0) ? over : zero) * (press + (one - press) / T(HARD));
      sizes[c - from] = slip(links[c], c, moved[c], ways[c - from]).x;
      rubs += sets[c].drag * sizes[c - from], whole += load[c], most += links[c].mu_k.x * load[c];
    }
    const L share = most / (rubs > T(0) ? rubs : one);
    for (int c = from; c < to; ++c) {
      Sets<T>& s = sets[c];
      V ignored;
      const L size = sizes[c - from], freely = slip(links[c], c, links[c].free, ignored).x;
      const L firm = stiff[c] * load[c] * T(to - from) / (whole > T(0) ? whole : one), limit = links[c].mu_k.x * load[c];
      const L known = (freely > size ? freely : size) * (one - share) + size * share;
      const L aimed = rubs > T(0) ? known : size - most * T(HARD) / stiff[c];
      const auto holds = ((s.slides > T(0)) & (aimed * firm < limit)) |
                         (~(s.slides > T(0)) & (rubs <= links[c].mu_s.x * whole));
      const L far = aimed > T(1e-30) ? aimed : zero + T(1e-30);
      const auto misled = (s.press > T(0)) & ~(s.slides > T(0)) & ~holds;
      const auto on = (links[c].wanted.x - dot(links[c].normal, moved[c]).x > T(0)) | misled;
      s = {on ? one : zero, holds ? zero : one, holds ? firm : limit / far, ways[c - from]};
    }
  }

  // The slope of a contact's force, (3, 3) row by row; with the exact one of sliding friction if a motion is given.
  void slope(int c, const V* moved, L* out) const {
    const Sets<T>& s = sets[c];
    const V& normal = links[c].normal;
    const L press = stiff[c] * s.press;
    L turning{}, load{}, along[3] = {s.slip.x.x, s.slip.y.x, s.slip.z.x};
    const L normals[3] = {normal.x.x, normal.y.x, normal.z.x};
    if (moved) {
      V way;
      const L size = slip(links[c], c, *moved, way).x;
      load = press * (links[c].wanted.x - dot(normal, *moved).x), load = load > T(0) ? load : zero;
      turning = links[c].mu_k.x * load / (size > T(1e-30) ? size : zero + T(1e-30));
    }
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const L both = normals[i] * normals[j], across = (i == j ? one : zero) - both;
        L value = press * both + s.drag * across;
        if (moved)
          value += s.slides * (turning * (across - along[i] * along[j]) - s.drag * across -
                               links[c].mu_k.x * press * along[i] * normals[j]);
        out[3 * i + j] = value;
      }
  }

  // Puts together and eliminates the matrix of the displacements of free bodies.
  void assemble(const List<V>* moved) {
    std::fill(system.a.begin(), system.a.end(), zero);
    for (int k = 0; k < n.bodies; ++k) {
      const int at = 6 * int(n.free[k]);
      if (at < 0) continue;
      for (int i = 0; i < 3; ++i) {
        system.at(at + i, at + i) += one / bodies[k].mobility.x;
        const V unit = {P(T(i == 0)), P(T(i == 1)), P(T(i == 2))}, column = bodies[k].resisted(unit);
        for (int j = 0; j < 3; ++j) system.at(at + 3 + j, at + 3 + i) += column[j].x;
      }
    }
    for (size_t c = 0; c < links.size(); ++c) {
      if (!active[owner[c]]) continue;
      const Link<T, 0>& l = links[c];
      L slopes[9], sight[2][3][6] = {}, push[3][6];
      slope(int(c), moved ? &(*moved)[c] : nullptr, slopes);
      const int at[2] = {6 * int(n.free[l.a]), 6 * int(n.free[l.b])};
      for (int side = 0; side < 2; ++side) {  // x + turn x arm, of the second body negative
        const L sign = zero + T(side ? -1 : 1), x = sign * l.arms[side].x.x, y = sign * l.arms[side].y.x;
        const L z = sign * l.arms[side].z.x;
        for (int i = 0; i < 3; ++i) sight[side][i][i] = sign;
        sight[side][0][4] = z, sight[side][0][5] = -y, sight[side][1][3] = -z;
        sight[side][1][5] = x, sight[side][2][3] = y, sight[side][2][4] = -x;
      }
      for (int to = 0; to < 2; ++to) {
        if (at[to] < 0) continue;
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 6; ++j)
            push[i][j] = slopes[3 * i] * sight[to][0][j] + slopes[3 * i + 1] * sight[to][1][j] +
                         slopes[3 * i + 2] * sight[to][2][j];
        for (int by = 0; by < 2; ++by)
          for (int i = 0; at[by] >= 0 && i < 6; ++i)
            for (int j = 0; j < 6; ++j)
              system.at(at[by] + i, at[to] + j) +=
                  sight[by][0][i] * push[0][j] + sight[by][1][i] * push[1][j] + sight[by][2][i] * push[2][j];
      }
    }
    system.eliminate();
  }

  // Motions of bodies from the unknowns, and unknowns from what is exerted on bodies.
  template <int N>
  Wrenches<N> spread(const List<Num<T, N>>& q) const {
    const Num<T, N> none(T(0));
    Wrenches<N> m(n.bodies, {{none, none, none}, {none, none, none}});
    for (int k = 0; k < n.bodies; ++k)
      if (n.free[k] >= 0) m[k] = *(const Wrench<T, N>*)&q[6 * n.free[k]];
    return m;
  }
  template <int N>
  List<Three<T, N>> moved(const List<Link<T, N>>& links, const List<Num<T, N>>& q) const {
    List<Three<T, N>> to(links.size());
    const Wrenches<N> m = spread(q);
    for (size_t c = 0; c < links.size(); ++c)
      if (active[owner[c]]) to[c] = links[c].free + seen(links[c], m);
    return to;
  }
  template <int N>
  List<Num<T, N>> gathered(const Wrenches<N>& w) const {
    List<Num<T, N>> q(system.n);
    for (int k = 0; k < n.bodies; ++k)
      for (int i = 0; n.free[k] >= 0 && i < 6; ++i) q[6 * n.free[k] + i] = ((const Num<T, N>*)&w[k])[i];
    return q;
  }

  void settle() {
    List<V> stays(links.size());
    for (int step = 0; step < n.steps; ++step) {
      assemble(nullptr);
      for (size_t c = 0; c < links.size(); ++c) {
        if (!active[owner[c]]) continue;
        L s[9];
        slope(int(c), nullptr, s);
        const V &f = links[c].free, rows[3] = {{P(s[0]), P(s[1]), P(s[2])}, {P(s[3]), P(s[4]), P(s[5])}, {P(s[6]), P(s[7]), P(s[8])}};
        const P press(stiff[c] * sets[c].press);
        stays[c] = links[c].normal * (press * links[c].wanted) - V{dot(rows[0], f), dot(rows[1], f), dot(rows[2], f)};
      }
      const List<P> right = gathered(this->exerted(links, stays));
      for (int i = 0; i < system.n; ++i) motion[i] = right[i].x;
      system.solve(motion);
      const List<V> found = moved(links, constants<0>(motion));
      for (int p = 0; p < n.pairs; ++p)
        if (active[p]) update(p, found);
    }
  }
  template <int N>
  static List<Num<T, N>> constants(const List<L>& x) {
    return List<Num<T, N>>(x.begin(), x.end());
  }

  // Finds contacts, and which of them press; returns whether any may.
  bool prepare() {
    near = false;
    for (int p = 0; p < n.pairs; ++p)
      if ((active[p] = this->close(p))) this->choose(p);
    links = this->template link<0>(bodies, contacts);
    motion.assign(system.n, zero);
    for (size_t c = 0; c < links.size(); ++c) {
      if (!active[owner[c]]) continue;
      const Link<T, 0>& l = links[c];
      stiff[c] = T(HARD) / (bodies[l.a].mobility.x + bodies[l.b].mobility.x);
      const auto on = ~(l.wanted.x - dot(l.normal, l.free).x <= -T(n.slowest * n.dt));
      near = near || any(on);
      sets[c] = {on ? one : zero, one, zero, {P(zero), P(zero), P(zero)}};
    }
    if (!near) return false;
    settle();
    // Rounds may leave what slides off the solution, and derivatives hold there only.
    linearize();
    List<P> more = excess<0>(bodies, links, constants<0>(motion));
    List<L> ahead(system.n);
    for (int i = 0; i < system.n; ++i) ahead[i] = more[i].x;
    system.solve(ahead);
    for (int i = 0; i < system.n; ++i) ahead[i] += motion[i];
    // Where both are at rounding, the step is taken too: else derivatives jump with the last bit of what is given.
    const L whole = weight(gathered(this->exerted(links, pressed(links, constants<0>(motion)))));
    const L little = weight(more) + std::numeric_limits<T>::epsilon() * whole;
    const auto better = weight(excess<0>(bodies, links, constants<0>(ahead))) < little;
    for (int i = 0; i < system.n; ++i) motion[i] = better ? ahead[i] : motion[i];
    linearize();
    return true;
  }
  // How much is left to do, (forces and torques)^2 over what resists them.
  L weight(const List<P>& more) const {
    L sum{};
    for (int k = 0; k < n.bodies; ++k)
      for (int i = 0; n.free[k] >= 0 && i < 3; ++i) {
        const V unit = {P(T(i == 0)), P(T(i == 1)), P(T(i == 2))};
        const L force = more[6 * n.free[k] + i].x, torque = more[6 * n.free[k] + 3 + i].x;
        sum += force * force * bodies[k].mobility.x + torque * torque / dot(unit, bodies[k].resisted(unit)).x;
      }
    return sum;
  }
  // Puts together the exact matrix at the displacements that were found.
  void linearize() {
    const List<V> found = moved(links, constants<0>(motion));
    for (size_t c = 0; c < links.size(); ++c)
      if (active[owner[c]]) slip(links[c], int(c), found[c], sets[c].slip);
    assemble(&found);
  }

  // What contacts exert at displacements of free bodies, and what that is beyond what displaces them so.
  template <int N>
  List<Three<T, N>> pressed(const List<Link<T, N>>& l, const List<Num<T, N>>& q) const {
    const List<Three<T, N>> m = moved(l, q);
    List<Three<T, N>> f(l.size());
    for (size_t c = 0; c < l.size(); ++c)
      if (active[owner[c]]) f[c] = this->force(l[c], int(c), m[c]);
    return f;
  }
  template <int N>
  List<Num<T, N>> excess(const Bodies<N>& b, const List<Link<T, N>>& l,
                                const List<Num<T, N>>& q) const {
    List<Num<T, N>> more = gathered(this->exerted(l, pressed(l, q)));
    for (int k = 0; k < n.bodies; ++k) {
      if (n.free[k] < 0) continue;
      const Wrench<T, N>& w = *(const Wrench<T, N>*)&q[6 * n.free[k]];
      const Three<T, N> back[2] = {w.force * (Num<T, N>(T(1)) / b[k].mobility), b[k].resisted(w.torque)};
      for (int i = 0; i < 6; ++i) more[6 * n.free[k] + i] = more[6 * n.free[k] + i] - back[i / 3][i % 3];
    }
    return more;
  }

  struct Unknowns {  // where they stand on the tape
    List<Num<T, TAPED>> excess, motion;
  };
  static Unknowns& last() {
    static thread_local Unknowns kept;
    return kept;
  }

  // How the force of a contact falls with the motion of its points, (3, 3) row by row; see `_firmness`.
  template <int N>
  void firmness(const Link<T, N>& l, int c, const Three<T, N>& moved, Num<T, N>* out) const {
    typedef Num<T, N> S;
    const Sets<T>& s = sets[c];
    Three<T, N> along;
    const S size = slip(l, c, moved, along), none(T(0)), unit(T(1));
    const S load = positive(S(stiff[c] * s.press) * (l.wanted - dot(l.normal, moved)));
    const auto slides = s.slides > T(0);
    const S mu = select(slides, l.mu_k, l.mu_s), limit = mu * load;
    const auto sticks = ~slides & (s.drag * size.x <= limit.x);
    const S drag = select(sticks, S(s.drag), limit / larger(larger(size, limit / S(stiff[c])), S(T(1e-30))));
    const S press(load.x > T(0) ? stiff[c] * s.press : zero);
    const S normals[3] = {l.normal.x, l.normal.y, l.normal.z}, ways[3] = {along.x, along.y, along.z};
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const S both = normals[i] * normals[j], ti = select(sticks, none, ways[i]), tj = select(sticks, none, ways[j]);
        out[3 * i + j] = press * both + drag * ((i == j ? unit : none) - both - ti * tj) - mu * press * ti * normals[j];
      }
  }
  // How what contacts exert on free bodies falls with the displacement of each alone.
  template <int N, typename M>
  void hold(const List<Link<T, N>>& l, const List<Three<T, N>>& moved, const M& good, List<Held<T, N>>& to) const {
    typedef Num<T, N> S;
    const S none(T(0)), unit(T(1));
    for (size_t c = 0; c < l.size(); ++c) {
      if (!active[owner[c]]) continue;
      S falls[9];
      firmness(l[c], int(c), moved[c], falls);
      for (S& x : falls) x = select(good, x, none);
      for (int side = 0; side < 2; ++side) {
        const int k = side ? l[c].b : l[c].a;
        if (n.free[k] < 0) continue;
        const Three<T, N>& arm = l[c].arms[side];
        for (int j = 0; j < 6; ++j) {
          const int axis = j % 3;
          const Three<T, N> e = {axis == 0 ? unit : none, axis == 1 ? unit : none, axis == 2 ? unit : none};
          const Three<T, N> m = j < 3 ? e : cross(e, arm);
          const auto row = [&](int i) { return falls[3 * i] * m.x + falls[3 * i + 1] * m.y + falls[3 * i + 2] * m.z; };
          const Three<T, N> force = {row(0), row(1), row(2)}, torque = cross(arm, force);
          const S fall[6] = {force.x, force.y, force.z, torque.x, torque.y, torque.z};
          for (int i = 0; i < 6; ++i) to[k].hold[6 * i + j] = to[k].hold[6 * i + j] + fall[i];
        }
      }
    }
  }

  // What contacts exert on bodies, from bodies and contacts.
  template <int N>
  Wrenches<N> finish(const Bodies<N>& b, const List<Touch<T, N>>& contacts, List<Held<T, N>>* held = nullptr) {
    typedef Num<T, N> S;
    const List<Link<T, N>> l = this->template link<N>(b, contacts);
    List<S> q = constants<N>(motion), more = excess(b, l, q);
    List<L> change(system.n);
    for (int i = 0; i < system.n; ++i) change[i] = more[i].x;
    system.solve(change);
    for (int i = 0; i < system.n; ++i) q[i] = S::variable(motion[i] + change[i], 0);
    if constexpr (N == TAPED) last() = {more, q};
    List<Three<T, N>> f = pressed(l, q);
    List<V> plain(f.size());
    for (size_t c = 0; c < f.size(); ++c) plain[c] = {P(f[c].x.x), P(f[c].y.x), P(f[c].z.x)};
    const auto good = this->template fitting<0>(bodies, links, plain).x > T(1 - FIT);
    if (any(~good)) simplify(b, l, good, f);
    if (held) hold(l, moved(l, q), good, *held);
    return this->exerted(l, f);
  }
  // Where rounds ended too early, all contacts press along their normals, by as much as fits at best.
  template <int N, typename M>
  void simplify(const Bodies<N>& b, const List<Link<T, N>>& l, const M& good, List<Three<T, N>>& f) {
    typedef Num<T, N> S;
    List<Three<T, N>> simple(f.size());
    for (size_t c = 0; c < f.size(); ++c)
      if (active[owner[c]])
        simple[c] = l[c].normal * (positive(l[c].wanted - dot(l[c].normal, l[c].free)) * S(stiff[c] / T(HARD)));
    const S share = this->fitting(b, l, simple);
    for (size_t c = 0; c < f.size(); ++c) {
      const Three<T, N> s = simple[c] * share;
      f[c] = {select(good, f[c].x, s.x), select(good, f[c].y, s.y), select(good, f[c].z, s.z)};
    }
  }

  template <int N>
  List<Held<T, N>> nothing() const {
    const Num<T, N> none(T(0));
    Held<T, N> empty;
    empty.wrench = {{none, none, none}, {none, none, none}};
    for (auto& x : empty.hold) x = none;
    return List<Held<T, N>>(n.bodies, empty);
  }
  // Returns derivatives by bodies, from those by what is exerted on them.
  Bodies<0> backward(const Wrenches<0>& by, const List<Held<T, 0>>* by_held = nullptr) {
    Bodies<0> to(n.bodies);
    for (auto& k : to)
      for (int i = 0; i < ALL; ++i) ((P*)&k)[i] = P(T(0));
    if (!near) return to;
    Tape<T>& tape = Tape<T>::on();
    tape.nodes.clear();
    Bodies<TAPED> b(n.bodies);
    List<Touch<T, TAPED>> c(contacts.size());
    for (int k = 0; k < n.bodies; ++k) this->template remember<ALL>(bodies[k], b[k]);
    for (size_t k = 0; k < c.size(); ++k)
      if (active[owner[k]]) this->template remember<FIELDS>(contacts[k], c[k]);
    List<Held<T, TAPED>> held;
    if (by_held) held = nothing<TAPED>();
    const Wrenches<TAPED> out = finish<TAPED>(b, c, by_held ? &held : nullptr);
    tape.begin();
    for (int k = 0; by_held && k < n.bodies; ++k)
      for (int i = 0; i < 36; ++i) held[k].hold[i].give((*by_held)[k].hold[i].x);
    for (int k = 0; k < n.bodies; ++k)
      for (int i = 0; i < 6; ++i) ((const Num<T, TAPED>*)&out[k])[i].give(((const P*)&by[k])[i].x);
    const Unknowns& at = last();
    const int from = at.motion.empty() ? 0 : at.motion[0].at;
    tape.back(int(tape.nodes.size()), from);
    // The displacements follow from the excess by the system, which is a constant.
    List<L> x;
    for (const auto& q : at.motion) x.push_back(q.by());
    system.solve_transposed(x);
    for (int i = 0; i < system.n; ++i) at.excess[i].give(x[i]);
    tape.back(from, 0);
    for (int k = 0; k < n.bodies; ++k) this->template collect<ALL>(b[k], to[k]);
    List<Touch<T, 0>> part(contacts.size());
    for (size_t k = 0; k < c.size(); ++k)
      for (int i = 0; active[owner[k]] && i < FIELDS; ++i) ((P*)&part[k])[i] = P(((Num<T, TAPED>*)&c[k])[i].by());
    for (int p = 0; p < n.pairs; ++p)
      for (int k = start[p]; active[p] && k < start[p + 1]; ++k) this->place_back(p, k, part, to);
    return to;
  }
};

// One per thread and kind of scene: memory for its blocks is asked for once.
template <typename T>
static Block<T>& working(const Sizes& n) {
  static thread_local std::unique_ptr<Block<T>> kept;
  const bool fits = kept && kept->n.shape == n.shape && kept->n.free == n.free && kept->n.pair == n.pair &&
                    kept->n.many == n.many && kept->n.bodies == n.bodies && kept->n.pairs == n.pairs &&
                    kept->n.points == n.points;
  if (!fits) kept.reset(new Block<T>(n));
  kept->n = n;
  return *kept;
}

#define BLOCKS _Pragma("omp parallel for num_threads(threads)") \
  for (int64_t b = 0; b < n.scenes; b += WIDTH<T>) if (const FlushTiny flush; true)

template <typename T>
static void exert(const T* const* in, T* const* out, const Sizes& n, int threads) {
  BLOCKS {
    Block<T>& block = working<T>(n);
    fetch(block.bodies, in, b, n.scenes);
    const Num<T, 0> none(T(0));
    const bool near = block.prepare();
    List<Wrench<T, 0>> found(n.bodies, {{none, none, none}, {none, none, none}});
    List<Held<T, 0>> held;
    if (n.hold) held = block.template nothing<0>();
    if (near) found = block.template finish<0>(block.bodies, block.contacts, n.hold ? &held : nullptr);
    for (size_t k = 0; k < held.size(); ++k) held[k].wrench = found[k];
    n.hold ? put(held, out, b, n.scenes) : put(found, out, b, n.scenes);
  }
}

template <typename T>
static void back(const T* const* in, const T* const* by, T* const* out, const Sizes& n, int threads) {
  BLOCKS {
    Block<T>& block = working<T>(n);
    fetch(block.bodies, in, b, n.scenes);
    List<Wrench<T, 0>> given(n.bodies);
    List<Held<T, 0>> held(n.hold ? n.bodies : 0);
    n.hold ? fetch(held, by, b, n.scenes) : fetch(given, by, b, n.scenes);
    for (size_t k = 0; k < held.size(); ++k) given[k] = held[k].wrench;
    block.prepare();
    put(block.backward(given, n.hold ? &held : nullptr), out, b, n.scenes);
  }
}

#define ENTRY(T)                                                                                                  \
  extern "C" void body_pairs_##T##_exert(const T* const* in, T* const* out, const Sizes* n, int threads) {        \
    exert<T>(in, out, *n, threads);                                                                               \
  }                                                                                                               \
  extern "C" void body_pairs_##T##_back(const T* const* in, const T* const* by, T* const* out, const Sizes* n,    \
                                        int threads) {                                                            \
    back<T>(in, by, out, *n, threads);                                                                            \
  }
ENTRY(float)
ENTRY(double)
