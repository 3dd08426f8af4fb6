// Pairs of edges of ropes that may touch in implicit steps, and their derivative; formulas and names as in `engage` of
// rod_contact_effect.py.
//
// Numbers come as (V, B) for each field of vertices below, (B) for each law, (4, K, B) for where the corners of pairs
// stand on the axis v B + b, (K, B) for whether they are pairs; what is found goes as (B, K, 43): real, normal, radius,
// wanted, mu, and four matrices of 3 x 3.
#include <algorithm>

#include "flush.h"
#include "rod_pairs.h"

struct Sizes {
  int64_t vertices, scenes, room, friction;
  double recovery, slowest, fastest, thick, dt;
};
enum { POS = 0, VEL = 3, CHANGE = 6, FREE = 9, RADIUS, FIELDS };
enum { MU_S, MU_K, RESTITUTION, LAWS };
constexpr int RESULTS = 43, MADE = 5;  // numbers of a pair, and how many of them stand before what `meet` makes

// Numbers of a pair with any number of derivatives, as in `Pair`.
template <typename T, int N>
struct Meeting {
  typedef Num<T, N> S;
  typedef Three<T, N> V;
  S s, t;
  V normal, between, arm[4];
  S xx, yy, zz, xy, xz, yz;
  S wanted;
  V vel[4];
  S mu_s, mu_k, restitution;
};

template <typename T>
struct Group {
  typedef Num<T, 0> P;
  typedef Three<T, 0> V;
  static constexpr int W = WIDTH<T>;
  int64_t pair[W], at[4][W];
  int count = 0;
  Lanes<T> real;
  Corners<T> corners;
  V vel[4], change[4];
  Pair<T> pair_;

  void add(int64_t k, const int64_t* corner, int64_t step) {
    const int lane = count++;
    for (int l = lane; l < (lane ? lane + 1 : W); ++l) {
      pair[l] = k;
      for (int c = 0; c < 4; ++c) at[c][l] = corner[c * step];
    }
  }
  static P pick(const T* from, const int64_t* at) {
    T found[W];
    for (int l = 0; l < W; ++l) found[l] = from[at[l]];
    P x;
    std::memcpy(&x.x, found, sizeof(found));
    return x;
  }
  void read(const T* const* in, const Sizes& n) {
    const auto three = [&](int field, int c) {
      return V{pick(in[field], at[c]), pick(in[field + 1], at[c]), pick(in[field + 2], at[c])};
    };
    for (int c = 0; c < 4; ++c) {
      corners.pos[c] = three(POS, c), vel[c] = three(VEL, c), change[c] = three(CHANGE, c);
      corners.free[c] = pick(in[FREE], at[c]);
    }
    for (int k = 0; k < 2; ++k) corners.radius[k] = pick(in[RADIUS], at[2 * k]);
    pair_ = ::pair(corners, n.friction, T(n.recovery));
    // What is not a number stays so.
    real = dot(pair_.between, pair_.between).x <= TINY<T> * TINY<T> ? Lanes<T>{} : Lanes<T>{} + T(1);
  }
  Meeting<T, 0> meeting(const T* laws) const {
    Meeting<T, 0> m;
    const Pair<T>& a = pair_;
    m.s = a.s, m.t = a.t, m.normal = a.normal, m.between = a.between, m.wanted = a.wanted;
    for (int c = 0; c < 4; ++c) m.arm[c] = a.arm[c], m.vel[c] = vel[c];
    m.xx = a.xx, m.yy = a.yy, m.zz = a.zz, m.xy = a.xy, m.xz = a.xz, m.yz = a.yz;
    m.mu_s = P(laws[MU_S]), m.mu_k = P(laws[MU_K]), m.restitution = P(laws[RESTITUTION]);
    return m;
  }
};

template <typename T, int N>
static Three<T, N> parted(const Meeting<T, N>& m, const Three<T, N>* x) {
  return x[0] + (x[1] - x[0]) * m.s - x[2] - (x[3] - x[2]) * m.t;
}

// Wanted, mu and the matrices, behind each other.
template <typename T, int N>
static void meet(const Meeting<T, N>& m, const Group<T>& g, const Sizes& n, Num<T, N>* to) {
  typedef Num<T, N> S;
  typedef Three<T, N> V;
  const S zero(T(0)), one(T(1)), most(T(n.fastest * n.dt)), asked = positive(m.wanted);
  S wanted = select(m.wanted.x > T(0), asked * most / (asked + most), m.wanted);
  const Lanes<T> radius = (g.corners.radius[0].x + g.corners.radius[1].x) * T(0.5);
  const Lanes<T> slowest = root<T>(radius * T(n.slowest * n.slowest / n.thick));
  if (any(m.restitution.x > T(0))) {
    const auto pressed = (g.real > T(0)) & (dot(g.pair_.normal, apart(g.pair_, g.change)).x < wanted.x);
    const S approach = -dot(m.normal, parted(m, m.vel)), back = m.restitution * approach * S(T(n.dt));
    const auto hits = pressed & (approach.x > slowest) & (back.x > T(0)) & (back.x > wanted.x);
    wanted = select(hits, back, wanted);
  }
  to[0] = wanted, to[1] = zero;
  const S share[4] = {one - m.s, m.s, m.t - one, -m.t};
  for (int c = 0; c < 4; ++c)
    for (int i = 0; i < 9; ++i) to[2 + 9 * c + i] = i % 4 ? zero : share[c];
  if (!n.friction) return;
  const Pair<T>& a = g.pair_;
  const Three<T, 0> slip = apart(a, g.vel) - cross(a.turned(moment(a, g.vel)), a.between);
  const Three<T, 0> across = slip - a.normal * dot(a.normal, slip);
  to[1] = select(root<T>(dot(across, across).x) > slowest, m.mu_k, m.mu_s);
  // Rows of (1 - n n^T) [d x] J, d from the second edge to the first and J the inverse of inertia; times [arm x].
  const V &d = m.between, &u = m.normal;
  const V J[3] = {{m.xx, m.xy, m.xz}, {m.xy, m.yy, m.yz}, {m.xz, m.yz, m.zz}};
  V rows[3] = {J[2] * d.y - J[1] * d.z, J[0] * d.z - J[2] * d.x, J[1] * d.x - J[0] * d.y};
  const V along = rows[0] * u.x + rows[1] * u.y + rows[2] * u.z;
  rows[0] -= along * u.x, rows[1] -= along * u.y, rows[2] -= along * u.z;
  for (int c = 0; c < 4; ++c)
    for (int i = 0; i < 3; ++i) {
      const V more = cross(rows[i], m.arm[c]);
      S* at = to + 2 + 9 * c + 3 * i;
      at[0] = at[0] + more.x, at[1] = at[1] + more.y, at[2] = at[2] + more.z;
    }
}

// Neighbouring scenes share lines of memory.
#define SCENES                                                                                \
  _Pragma("omp parallel for schedule(static, 8) num_threads(threads) if (threads > 1)") \
  for (int64_t b = 0; b < n.scenes; ++b) if (const FlushTiny flush; true)

// Does something with the pairs of a scene, some side by side, that `uses` says yes to.
template <typename T, typename U, typename D>
static void groups(const T* const* in, const int64_t* at, const T* real, const Sizes& n, int64_t b, U uses, D work) {
  Group<T> g;
  const auto end = [&]() {
    if (!g.count) return;
    g.read(in, n);
    work(g);
    g.count = 0;
  };
  for (int64_t k = 0; k < n.room; ++k) {
    if (!(real[k * n.scenes + b] > T(0)) || !uses(k)) continue;
    g.add(k, at + k * n.scenes + b, n.room * n.scenes);
    if (g.count == WIDTH<T>) end();
  }
  end();
}

template <typename T>
static void find(const T* const* in, const T* const* laws, const int64_t* at, const T* real, T* out, const Sizes& n,
                 int threads) {
  SCENES {
    T* mine = out + b * n.room * RESULTS;
    std::fill(mine, mine + n.room * RESULTS, T(0));
    // Where the list has room left, all is 0 but the radius, by which forces are divided.
    for (int64_t k = 0; k < n.room; ++k) mine[k * RESULTS + MADE - 1] = T(1);
    const T law[LAWS] = {laws[MU_S][b], laws[MU_K][b], laws[RESTITUTION][b]};
    groups(in, at, real, n, b, [](int64_t) { return true; }, [&](const Group<T>& g) {
      Num<T, 0> found[RESULTS];
      const Pair<T>& a = g.pair_;
      found[0] = Num<T, 0>(g.real);
      for (int i = 0; i < 3; ++i) found[1 + i] = a.normal[i];
      found[4] = Num<T, 0>(T(0.5)) * (g.corners.radius[0] + g.corners.radius[1]);
      meet(g.meeting(law), g, n, found + MADE);
      for (int l = 0; l < g.count; ++l)
        for (int f = 0; f < RESULTS; ++f) mine[g.pair[l] * RESULTS + f] = found[f].x[l];
    });
  }
}

template <typename T>
static void back(const T* const* in, const T* const* laws, const int64_t* at, const T* real, const T* by,
                 T* const* to, T* const* to_laws, const Sizes& n, int threads) {
  SCENES {
    typedef Num<T, TAPED> R;
    typedef Num<T, 0> P;
    const T* mine = by + b * n.room * RESULTS;
    const T law[LAWS] = {laws[MU_S][b], laws[MU_K][b], laws[RESTITUTION][b]};
    const auto uses = [&](int64_t k) {
      for (int f = 1; f < RESULTS; ++f)
        if (mine[k * RESULTS + f] != T(0)) return true;
      return false;
    };
    groups(in, at, real, n, b, uses, [&](const Group<T>& g) {
      Lanes<T> wanted[RESULTS] = {};
      for (int l = 0; l < g.count; ++l)
        for (int f = 0; f < RESULTS; ++f) wanted[f][l] = mine[g.pair[l] * RESULTS + f];
      const Meeting<T, 0> given = g.meeting(law);
      constexpr int ALL = sizeof(given) / sizeof(P);
      Tape<T>& tape = Tape<T>::on();
      tape.nodes.clear();
      Meeting<T, TAPED> m;
      for (int i = 0; i < ALL; ++i) ((R*)&m)[i] = R::variable(((const P*)&given)[i].x, 0);
      R found[RESULTS - MADE];
      meet(m, g, n, found);
      tape.begin();
      for (int f = MADE; f < RESULTS; ++f) found[f - MADE].give(wanted[f]);
      for (int i = 0; i < 3; ++i) (&m.normal.x)[i].give(wanted[1 + i]);
      tape.back(int(tape.nodes.size()), 0);
      Pair<T> d;
      const auto three = [](const Three<T, TAPED>& x) { return Three<T, 0>{P(x.x.by()), P(x.y.by()), P(x.z.by())}; };
      d.s = P(m.s.by()), d.t = P(m.t.by()), d.normal = three(m.normal), d.between = three(m.between);
      for (int c = 0; c < 4; ++c) d.arm[c] = three(m.arm[c]);
      d.xx = P(m.xx.by()), d.yy = P(m.yy.by()), d.zz = P(m.zz.by());
      d.xy = P(m.xy.by()), d.xz = P(m.xz.by()), d.yz = P(m.yz.by());
      d.turning = P(T(0)), d.wanted = P(m.wanted.by());
      Corners<T> c;
      for (int i = 0; i < int(sizeof(c) / sizeof(P)); ++i) ((P*)&c)[i] = P(T(0));
      pair_back(g.corners, g.pair_, n.friction, T(n.recovery), d, c);
      for (int k = 0; k < 2; ++k) c.radius[k].x += T(0.5) * wanted[4];
      const auto add = [&](int field, int corner, const Lanes<T>& x) {
        for (int l = 0; l < g.count; ++l) to[field][g.at[corner][l]] += x[l];
      };
      for (int q = 0; q < 4; ++q) {
        const Three<T, 0> vel = three(m.vel[q]);
        for (int i = 0; i < 3; ++i) add(POS + i, q, c.pos[q][i].x), add(VEL + i, q, vel[i].x);
        add(FREE, q, c.free[q].x);
      }
      for (int k = 0; k < 2; ++k) add(RADIUS, 2 * k, c.radius[k].x);
      const R* coefficients = &m.mu_s;
      for (int f = 0; f < LAWS; ++f) to_laws[f][b] += sum(P(coefficients[f].by()), g.count);
    });
  }
}

#define ENTRY(name, T)                                                                                             \
  extern "C" void name##_find(const T* const* in, const T* const* laws, const int64_t* at, const T* real, T* out,  \
                              const Sizes* n, int threads) {                                                       \
    find<T>(in, laws, at, real, out, *n, threads);                                                                 \
  }                                                                                                                \
  extern "C" void name##_back(const T* const* in, const T* const* laws, const int64_t* at, const T* real,          \
                              const T* by, T* const* to, T* const* to_laws, const Sizes* n, int threads) {         \
    back<T>(in, laws, at, real, by, to, to_laws, *n, threads);                                                     \
  }
ENTRY(rod_touch_float, float)
ENTRY(rod_touch_double, double)
